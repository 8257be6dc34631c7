"""Putting a motion on the ground with nothing but the body's rest joints."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from caphy.conventions import JOINT_NAMES, JOINT_PARENTS
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.skeleton import forward_kinematics
from caphy.rotations import matrix_from_axis_angle

STANCE_QUANTILE: Final = 0.02
"""Part of the frames whose lowest sole may be below the ground: noise of the feet, not stance."""


def world_joints(sequence: PoseSequence, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (T, 55, 3, 3) and positions (T, 55, 3) [m] of a body with rest ``joints`` (55, 3)."""
    parents = np.array(JOINT_PARENTS)
    offsets = joints - joints[np.maximum(parents, 0)]
    root = sequence.transl + joints[0]
    return forward_kinematics(matrix_from_axis_angle(sequence.poses), offsets, parents, root)


def sole_heights(sequence: PoseSequence, joints: np.ndarray, sole: float) -> np.ndarray:
    """Height of the lower end of each sole (T, 2) [m], left and right; y up.

    A sole is three points at the height ``sole`` of the rest pose: under the ankle and under the ball, which move
    with the ankle, and the toe's tip ahead of the ball, which moves with the ball.
    """
    rotations, positions = world_joints(sequence, joints)
    heights = []
    for side in ("left", "right"):
        ankle, ball = (JOINT_NAMES.index(f"{side}_{name}") for name in ("ankle", "foot"))
        ahead = joints[ball] - joints[ankle]
        points = [(ankle, [0, sole - joints[ankle, 1], 0]), (ball, [0, sole - joints[ball, 1], 0])]
        points.append((ball, [ahead[0] / 2, sole - joints[ball, 1], ahead[2] / 2]))
        ends = [positions[:, joint, 1] + rotations[:, joint, 1] @ np.array(point) for joint, point in points]
        heights.append(np.min(ends, axis=0))
    return np.stack(heights, axis=-1)


def on_ground(sequence: PoseSequence, joints: np.ndarray, sole: float) -> PoseSequence:
    """The motion shifted up or down as a whole, so that it stands on y = 0 with the body of rest ``joints``.

    The lowest sole touches in all but 2 % of the frames; jumps stay jumps. The translation is re-expressed for this
    body's pelvis, since a translation means nothing without it.
    """
    here = replace(sequence, transl=sequence.transl + sequence.pelvis - joints[0], pelvis=joints[0])
    lowest = np.quantile(sole_heights(here, joints, sole).min(axis=1), STANCE_QUANTILE)
    return replace(here, transl=here.transl - [0.0, float(lowest), 0.0])
