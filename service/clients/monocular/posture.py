"""Which postures bodies take: what inverse kinematics believes where the picture says nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

import caphy
from caphy.conventions import BODY_JOINT_COUNT, JOINT_NAMES

USUAL: Final[dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]]] = {
    "left_hip": ((-16, -5, -5), (24, 10, 8)),
    "spine1": ((7, 0, 0), (9, 4, 4)),
    "left_knee": ((28, 0, 6), (30, 3, 2)),
    "spine2": ((1, 0, 0), (4, 5, 4)),
    "left_ankle": ((-5, 9, 0), (15, 10, 4)),
    "spine3": ((-3, 0, 0), (5, 4, 4)),
    "left_foot": ((-6, 0, 0), (1, 1, 1)),
    "neck": ((0, 0, 0), (9, 12, 7)),
    "left_collar": ((0, 0, 0), (3, 5, 5)),
    "head": ((18, 0, 0), (12, 10, 8)),
    "left_shoulder": ((16, -24, -62), (32, 40, 36)),
    "left_elbow": ((-3, -47, 22), (16, 40, 18)),
    "left_wrist": ((0, 5, 12), (16, 26, 16)),
}
"""Mean and spread of each joint's axis-angle [degrees], for the middle and the left side: where limits lie.

From 23 clips of the CMU motion capture database (walking, running, jumping, ball games, signals), retargeted to the
bundled body, left and right joined; spreads widened, for people do more than that.
"""

FLEXION: Final[dict[str, tuple[int, float, float]]] = {
    "left_knee": (0, -3, 150),
    "right_knee": (0, -3, 150),
    "left_elbow": (1, -150, 3),
    "right_elbow": (1, -3, 150),
}
"""Joints that bend one way only: component of the axis-angle, least and most [degrees] (AAOS, "Joint Motion", 1965)."""


STATISTICS: Final = Path(caphy.__file__).parent / "data" / "pose_statistics.npz"
"""Mean and covariance of 30 CMU clips, left and right alike (:mod:`caphy.register.pose_statistics`)."""
UNKNOWN: Final = np.radians(5.0)
"""Added to the spread of every angle: there are other postures than those of the clips [rad]."""
WIDER: Final = 1.5
"""Hips bend by so much more than in the clips, most of which walk: seen thighs should say how the pelvis tilts."""


def postures() -> tuple[np.ndarray, np.ndarray]:
    """Mean (63,) [rad] and precision (63, 63) of the axis-angles of the 21 body joints, one Gaussian over all of them.

    What is seen of one joint tells something of others: of the upper arm by the forearm, which alone cannot be turned.
    """
    with np.load(STATISTICS, allow_pickle=False) as arrays:
        mean, covariance = arrays["mean"].astype(np.float64), arrays["covariance"].astype(np.float64)
    wider = np.ones((BODY_JOINT_COUNT - 1, 3))
    wider[[JOINT_NAMES.index(name) - 1 for name in ("left_hip", "right_hip")], 0] = WIDER
    covariance *= np.outer(wider, wider)
    return mean, np.linalg.inv(covariance + UNKNOWN**2 * np.eye(len(mean)))


def usual_posture() -> tuple[np.ndarray, np.ndarray]:
    """Mean and spread (22, 3) of the axis-angle of pelvis and body joints [rad]; the pelvis' mean nothing."""
    mean, spread = np.zeros((BODY_JOINT_COUNT, 3)), np.ones((BODY_JOINT_COUNT, 3))
    for joint, name in enumerate(JOINT_NAMES[1:BODY_JOINT_COUNT], start=1):
        middle, width = (np.radians(values) for values in USUAL[name.replace("right_", "left_")])
        mean[joint] = middle * ([1, -1, -1] if name.startswith("right_") else [1, 1, 1])
        spread[joint] = width
    return mean, spread


def limits() -> tuple[np.ndarray, np.ndarray]:
    """Least and most (22, 3) of each joint's axis-angle [rad]: three spreads about the mean, or one-way bending."""
    mean, spread = usual_posture()
    low, high = mean - 3 * spread, mean + 3 * spread
    for name, (axis, least, most) in FLEXION.items():
        low[JOINT_NAMES.index(name), axis], high[JOINT_NAMES.index(name), axis] = np.radians([least, most])
    return low, high
