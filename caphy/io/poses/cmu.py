"""CMU motion capture clips, retargeted to the bundled body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from caphy.io.poses.asfamc import read_amc
from caphy.io.poses.bvh import read_bvh
from caphy.io.poses.sequence import Y_UP_FROM_Z_UP, PoseSequence
from caphy.io.poses.skeleton import SkeletonMotion
from caphy.io.retarget import retarget
from caphy.io.retarget_rest import default_rest
from caphy.rotations import axis_angle_from_matrix

CALIBRATION_JOINTS: Final = 6
"""At most so many joints are bent in the T-pose that the cgspeed conversion puts before the first frame."""


def read_cmu_bvh(path: Path, fps: float | None = None, up: Literal["y", "z"] | None = None) -> PoseSequence:
    """A clip of the CMU database as BVH; ``fps`` [Hz] overrides the file's, y is ``up`` unless said otherwise.

    Raises :class:`CaphyError`.
    """
    return retarget(without_calibration_frame(upright(read_bvh(path, fps), up)), default_rest())


def read_cmu_amc(path: Path, fps: float | None = None, up: Literal["y", "z"] | None = None) -> PoseSequence:
    """A clip of the CMU database as AMC with its ASF beside it; ``fps`` [Hz] must be given."""
    return retarget(upright(read_amc(path, fps), up), default_rest())


def upright(motion: SkeletonMotion, up: Literal["y", "z"] | None) -> SkeletonMotion:
    """The motion with y up, skeleton and world turned alike."""
    if up != "z":
        return motion
    turn = Y_UP_FROM_Z_UP
    return replace(
        motion,
        offsets=motion.offsets @ turn.T,
        tips=motion.tips @ turn.T,
        rotations=turn @ motion.rotations @ turn.T,
        root=motion.root @ turn.T,
    )


def without_calibration_frame(motion: SkeletonMotion) -> SkeletonMotion:
    """The motion without the T-pose some conversions put first, which no frame leads to or from."""
    if len(motion.root) < 2:
        return motion
    angles = np.linalg.norm(axis_angle_from_matrix(motion.rotations[:2]), axis=-1)
    bent = np.count_nonzero(angles > 1e-9, axis=-1)
    if angles[0, 0] > 1e-9 or bent[0] > CALIBRATION_JOINTS or bent[1] <= CALIBRATION_JOINTS:
        return motion
    return replace(
        motion,
        rotations=motion.rotations[1:],
        root=motion.root[1:],
        notes=(*motion.notes, "the first frame is a T-pose of calibration and was dropped"),
    )
