"""Putting a motion on the ground with nothing but the body's rest joints."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from caphy.conventions import GRAVITY, JOINT_NAMES, JOINT_PARENTS
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.skeleton import forward_kinematics
from caphy.rotations import matrix_from_axis_angle

STANCE_SMOOTHING: Final = 0.06
"""Width of the Gaussian over which the soles' height is taken [s]: a fraction of a step, more than marker noise."""

FLIGHT_SMOOTHING: Final = 0.04
"""Width of the Gaussian before the root's acceleration is taken [s]."""


def world_joints(sequence: PoseSequence, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (T, 55, 3, 3) and positions (T, 55, 3) [m] of a body with rest ``joints`` (55, 3)."""
    parents = np.array(JOINT_PARENTS)
    offsets = joints - joints[np.maximum(parents, 0)]
    root = sequence.transl + joints[0]
    return forward_kinematics(matrix_from_axis_angle(sequence.poses), offsets, parents, root)


def sole_points(sequence: PoseSequence, joints: np.ndarray, sole: float) -> np.ndarray:
    """World positions (T, 6, 3) [m] of the ends of both soles, the left foot's three first.

    A sole is three points at the height ``sole`` of the rest pose: under the ankle and under the ball, which move
    with the ankle, and the toe's tip ahead of the ball, which moves with the ball.
    """
    rotations, positions = world_joints(sequence, joints)
    points = []
    for side in ("left", "right"):
        ankle, ball = (JOINT_NAMES.index(f"{side}_{name}") for name in ("ankle", "foot"))
        heel, under = (np.array([0.0, sole - joints[joint, 1], 0.0]) for joint in (ankle, ball))
        tip = under + (joints[ball] - joints[ankle]) * [0.5, 0.0, 0.5]
        tread = np.array([*joints[ball, [0, 2]], sole])[[0, 2, 1]] - joints[ankle]
        points += [
            positions[:, joint] + rotations[:, joint] @ p for joint, p in ((ankle, heel), (ankle, tread), (ball, tip))
        ]
    return np.stack(points, axis=1)


def sole_heights(sequence: PoseSequence, joints: np.ndarray, sole: float) -> np.ndarray:
    """Height of the lowest end of each sole (T, 2) [m], left and right; y up."""
    return sole_points(sequence, joints, sole)[..., 1].reshape(-1, 2, 3).min(axis=-1)


def on_ground(sequence: PoseSequence, joints: np.ndarray, sole: float) -> PoseSequence:
    """The motion raised or lowered frame by frame, so that the lower sole stands on y = 0 except in flight.

    Captured skeletons differ from the body in limb lengths and float or sink by some centimetres within each step.
    The height of the lower sole, smoothed in time, is taken off; across a flight, where the pelvis falls freely,
    the correction runs straight from take-off to landing, so that jumps keep their height. The translation is
    re-expressed for this body's pelvis, since a translation means nothing without it.
    """
    here = sequence.about(joints[0])
    lowest = sole_heights(here, joints, sole).min(axis=1)
    stands = np.flatnonzero(~in_flight(here))
    if len(stands):
        frames = np.arange(len(here))
        lowest = smoothed(np.interp(frames, stands, lowest[stands]), STANCE_SMOOTHING * here.fps)
    else:
        lowest = np.full(len(here), lowest.min())
    stood = replace(here, transl=here.transl - lowest[:, None] * [0.0, 1.0, 0.0])
    return stood.with_notes("set on the ground y = 0 by its feet, frame by frame except in flight")


def placed_on(sequence: PoseSequence, joints: np.ndarray, sole: float) -> PoseSequence:
    """The motion on another body than the one its translation refers to, on the ground; as it is on its own body."""
    return sequence if np.allclose(sequence.pelvis, joints[0]) else on_ground(sequence.to_y_up(), joints, sole)


def in_flight(sequence: PoseSequence) -> np.ndarray:
    """Whether the root falls freely (T,): its acceleration is more than half of gravity downwards."""
    if len(sequence) < 3:
        return np.zeros(len(sequence), dtype=bool)
    height = smoothed(sequence.transl[:, 1], FLIGHT_SMOOTHING * sequence.fps)
    acceleration = np.gradient(np.gradient(height)) * sequence.fps**2
    return acceleration < 0.5 * GRAVITY[1]


def smoothed(values: np.ndarray, sigma: float) -> np.ndarray:
    """Values (T,) blurred by a Gaussian of ``sigma`` frames; the ends are mirrored through their end point."""
    reach = min(int(np.ceil(3 * sigma)), len(values) - 1)
    if reach < 1:
        return values
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    before, after = 2 * values[0] - values[reach:0:-1], 2 * values[-1] - values[-2 : -reach - 2 : -1]
    return np.convolve(np.concatenate([before, values, after]), kernel / kernel.sum(), mode="valid")
