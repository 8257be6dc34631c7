"""A motion through postures that no body takes one after another, for what must hold on every motion."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.skeleton import axis_rotations
from caphy.io.procedural_limits import limits
from caphy.rotations import axis_angle_from_matrix

HOLD: Final = 0.5
"""Time from one posture to the next [s]."""
TILT: Final = np.radians(30.0)
"""Most that the pelvis turns about each axis, either way [rad]."""


def posture_motion(seed: int = 0, seconds: float = 20.0, fps: float = 30.0) -> PoseSequence:
    """Postures drawn from ``seed``, each joint anywhere within :func:`limits`, eased from one to the next; the body
    hangs in the air, and its parts pass through one another."""
    ranges = limits()
    ranges[0] = [-TILT, TILT]
    count = round(seconds * fps) + 1
    step = np.arange(count) / fps / HOLD
    before, share = step.astype(int), (step % 1)[:, None, None]
    size = (int(before[-1]) + 2, *ranges.shape[:2])
    postures = np.random.default_rng(seed).uniform(ranges[..., 0], ranges[..., 1], size)
    angles = postures[before] + (postures[before + 1] - postures[before]) * share**2 * (3 - 2 * share)
    rotations = (
        axis_rotations(0, angles[..., 0]) @ axis_rotations(1, angles[..., 1]) @ axis_rotations(2, angles[..., 2])
    )
    return PoseSequence(
        poses=axis_angle_from_matrix(rotations),
        transl=np.zeros((count, 3)),
        fps=fps,
        source=f"postures, seed {seed}",
        notes=("made by formula, not captured",),
    )
