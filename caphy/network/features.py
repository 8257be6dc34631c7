"""What the network sees of a pose: the same whichever way the person faces and wherever they stand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor

from caphy.conventions import JOINT_PARENTS, MOTION_STATE
from caphy.rotations import sixd_from_matrix

VELOCITY_UNIT: Final = 1.0
"""Root speed that becomes one [m/s]."""
ACCELERATION_UNIT: Final = 10.0
"""Root acceleration that becomes one [m/s^2]: about that of gravity."""
ANGULAR_UNIT: Final = 3.0
"""Root turning speed that becomes one [rad/s]."""
LIMIT: Final = 5.0
"""Scaled velocities are cut here, so that a jump of the tracker cannot throw the network out of what it knows."""


def driving_joints(weights: np.ndarray, parents: Sequence[int] = JOINT_PARENTS, least: float = 0.05) -> list[int]:
    """Joints whose rotation moves a garment of skinning weights (V, 55): those it hangs on and all that carry them.

    A joint counts if some vertex follows it by at least ``least``. The root is left out: its turning enters as
    gravity's direction and as angular velocity.
    """
    moved = {int(joint) for joint in np.flatnonzero(np.max(weights, axis=0) >= least)}
    for joint in range(len(parents) - 1, 0, -1):  # children come after their parents
        if joint in moved:
            moved.add(parents[joint])
    return sorted(moved - {0})


def feature_count(joints: Sequence[int]) -> int:
    """Length D of a frame's features."""
    return 6 * len(joints) + 12


def rest_state(reference: Tensor) -> Tensor:
    """The motion's state (16,) before the first frame, in the dtype and on the device of ``reference``."""
    return reference.new_zeros(MOTION_STATE)


def pose_features(
    rotations: Tensor, transl: Tensor, state: Tensor, joints: Sequence[int], fps: float
) -> tuple[Tensor, Tensor]:
    """Features (T, D) of T consecutive frames, and the state (16,) after them.

    Columns: the driving joints' relative rotations in 6D, gravity's direction, the root's velocity, acceleration and
    angular velocity, all in the root's frame and scaled to order one. The first frame of a stream has no velocity,
    the first two have no acceleration.

    Args:
        rotations: relative rotations of the joints, (T, 55, 3, 3).
        transl: root translation [m], (T, 3), y up.
        state: state before the first frame, (16,), see :data:`caphy.conventions.MOTION_STATE`.
        joints: see :func:`driving_joints`.
        fps: frames per second [Hz].
    """
    root = rotations[:, 0]
    seen = state[15] + torch.cumsum(torch.ones_like(transl[:, :1]), 0) - 1  # frames before this one
    known = torch.clamp(seen[:1], 0, 1)
    before = known * state[None, 0:3] + (1 - known) * transl[:1]
    turned_before = known[..., None] * state[6:15].reshape(1, 3, 3) + (1 - known[..., None]) * root[:1]

    velocity = (transl - torch.cat([before, transl[:-1]])) * fps
    acceleration = (velocity - torch.cat([state[None, 3:6], velocity[:-1]])) * fps * torch.clamp(seen - 1, 0, 1)
    turn = torch.cat([turned_before, root[:-1]]).mT @ root  # in the root's frame
    spin = torch.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], -1
    )

    motion = torch.cat(
        [
            -root[:, 1],  # R^T (0, -1, 0)
            _limited(_into(root, velocity) / VELOCITY_UNIT),
            _limited(_into(root, acceleration) / ACCELERATION_UNIT),
            _limited(spin * (0.5 * fps / ANGULAR_UNIT)),
        ],
        -1,
    )
    shape = sixd_from_matrix(rotations[:, list(joints)]).flatten(1)
    after = torch.cat([transl[-1], velocity[-1], root[-1].reshape(9), torch.clamp(seen[-1] + 1, 0, 2)])
    return torch.cat([shape, motion], -1), after


def as_first_frames(features: Tensor) -> Tensor:
    """Features (..., T, D) of streams that start here, from those of the middle of a motion."""
    start = features.clone()
    start[..., :1, -9:-6] = 0  # velocity
    start[..., :2, -6:-3] = 0  # acceleration
    start[..., :1, -3:] = 0  # angular velocity
    return start


def as_held(features: Tensor) -> Tensor:
    """Features (..., D) of poses that are held, from those of a motion through them."""
    still = features.clone()
    still[..., -9:] = 0
    return still


def _into(root: Tensor, vectors: Tensor) -> Tensor:
    """World vectors (T, 3) in the frame of root rotations (T, 3, 3)."""
    return (root.mT @ vectors[..., None])[..., 0]


def _limited(values: Tensor) -> Tensor:
    return torch.clamp(values, -LIMIT, LIMIT)
