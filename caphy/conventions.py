"""Units, axes, shape words and joint names that every module shares.

SI units throughout: metres, seconds, kilograms, newtons, joules, radians. Axes are right-handed, y up; the body
faces +z and its left hand points to +x in the T-pose. Gravity is (0, -9.81, 0) m/s^2.

Shape words used in docstrings: T frames, V vertices, F faces, H hinges, J joints, B a batch (any leading axes).
"""

from typing import Final

GRAVITY: Final = (0.0, -9.81, 0.0)
"""Acceleration of free fall [m/s^2], y up."""

JOINT_NAMES: Final[tuple[str, ...]] = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "jaw",
    "left_eye",
    "right_eye",
    *(f"left_{f}{i}" for f in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3)),
    *(f"right_{f}{i}" for f in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3)),
)
"""The 55 joints of SMPL-X in its order (Pavlakos et al., CVPR 2019)."""

JOINT_COUNT: Final = len(JOINT_NAMES)
BODY_JOINT_COUNT: Final = 22
"""Pelvis and the 21 body joints, the first of :data:`JOINT_NAMES`."""

JOINT_PARENTS: Final[tuple[int, ...]] = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15),
    *(20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38),
    *(21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53),
)
"""Parent joint of each joint; the root's is -1."""

MOTION_STATE: Final = 16
"""Length of the motion's part at the end of a network's state: root translation (3), velocity (3), rotation (9,
row-major) and the number of frames seen, 0, 1 or 2. Before it stands the GRU's memory."""
