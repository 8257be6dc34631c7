"""Motions that are known only from a camera's view."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from caphy.io.poses.sequence import PoseSequence

OPENCV_TO_Y_UP: Final = np.diag([1.0, -1.0, -1.0])
"""From a camera's axes (x right, y down, z ahead) to y up, looking along -z."""


def level_camera(sequence: PoseSequence) -> PoseSequence:
    """A sequence given in a camera's axes, with y up as if the camera were level; its frame is "camera"."""
    return replace(sequence.turned(OPENCV_TO_Y_UP), frame="camera", up_axis="y").with_notes(
        "camera frame: where gravity points is not known; the camera is taken as level and still"
    )
