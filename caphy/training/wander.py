"""Poses beside those of a motion: each joint strays from it slowly, so that a network learns uncaptured postures."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter1d

from caphy.conventions import JOINT_NAMES
from caphy.io.poses import PoseSequence
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle

SLOWNESS: Final = 0.4
"""Width of the Gaussian that smooths the straying [s]."""

STRAY: Final[dict[str, tuple[float, float, float]]] = {
    "pelvis": (10, 0, 8),
    "spine1": (10, 6, 6),
    "spine2": (6, 6, 5),
    "spine3": (6, 6, 5),
    "neck": (5, 6, 4),
    "left_collar": (3, 5, 6),
    "left_shoulder": (10, 12, 12),
    "left_elbow": (5, 14, 5),
    "left_hip": (16, 6, 6),
    "left_knee": (14, 0, 0),
}
"""How far joints stray about x, y and z of their own axes, root mean square [degrees]; right ones like left ones."""

ONE_WAY: Final = {("left_shoulder", 2): 1.0, ("left_elbow", 1): -1.0, ("left_knee", 0): 1.0}
"""Straying that goes one way only: arms leave the trunk, elbows and knees bend. Right ones are mirrored."""


def wandering(sequence: PoseSequence, rng: np.random.Generator) -> PoseSequence:
    """The sequence with every joint turned by a smooth random motion of its own; places and times stay."""
    away = np.zeros((len(sequence), len(JOINT_NAMES), 3))
    for joint, name in enumerate(JOINT_NAMES):
        left = name.replace("right_", "left_")
        for axis, degrees in enumerate(STRAY.get(left, (0, 0, 0))):
            course = _course(len(sequence), sequence.fps, rng)
            if (left, axis) in ONE_WAY:
                mirror = -1.0 if name != left and axis else 1.0  # at x = 0: turns about y and z change sign
                course = np.abs(course) * ONE_WAY[left, axis] * mirror
            away[:, joint, axis] = np.radians(degrees) * course
    turned = matrix_from_axis_angle(sequence.poses) @ matrix_from_axis_angle(away)
    return replace(sequence, poses=axis_angle_from_matrix(turned), source=f"{sequence.source}, wandering")


def _course(count: int, fps: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth random function of time (T,) of unit variance."""
    sigma = SLOWNESS * fps
    margin = int(np.ceil(4 * sigma))
    noise = gaussian_filter1d(rng.normal(size=count + 2 * margin), sigma)[margin : margin + count]
    return noise * np.sqrt(2 * np.sqrt(np.pi) * sigma)
