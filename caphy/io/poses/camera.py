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


def at_usual_distance(transl: np.ndarray, focal: np.ndarray | float, size: np.ndarray) -> np.ndarray:
    """Translations (T, 3) [m] in a camera's axes as a usual camera would have seen them.

    Estimators that assume a long focal length ``focal`` [pixels] put people 10 to 50 m away, where an error of
    1 % in their size is a jump. A usual camera's focal length is the diagonal of its pictures of width and height
    ``size`` (..., 2) [pixels]; what is nearer by the ratio of focal lengths is seen at the same place.
    """
    diagonal = np.linalg.norm(size, axis=-1)
    return transl * np.stack(np.broadcast_arrays(1.0, 1.0, diagonal / focal), axis=-1)
