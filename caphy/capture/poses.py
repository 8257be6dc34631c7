"""Which poses are captured: one A-pose, then stills of motion capture that differ from one another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from caphy.body.model import BodyModel
from caphy.conventions import BODY_JOINT_COUNT, JOINT_COUNT, JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence
from caphy.io.procedural import procedural_motion
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle

ARMS_DOWN = np.radians(50.0)
"""How far the A-pose's arms hang below the horizontal."""
EVERY = 0.2
"""Time between the stills that poses are chosen from [s]."""
LARGEST_BEND = np.radians(95.0)
"""Hips bent farther are left out: linear blend skinning collapses there."""


def capture_poses(clips: Path | None, count: int, body: BodyModel, seed: int) -> PoseSequence:
    """``count`` poses as the frames of one sequence: the A-pose, then stills of the clips in a folder.

    Without a folder they come from procedural motions. Each person stands over the origin, on y = 0. Stills are
    chosen to be unlike the A-pose and one another: the farthest from those already chosen, of five times as many drawn
    at random.

    Raises:
        CaphyError: the clips cannot be read, or hold too few stills.
    """
    random = np.random.default_rng([seed, 2])
    pool = np.concatenate([_stills(clip) for clip in _clips(clips, seed)])
    pool = pool[np.linalg.norm(pool[:, 1:3], axis=2).max(axis=1) < LARGEST_BEND]
    if len(pool) < count - 1:
        raise CaphyError(
            f"{clips}: its motions give {len(pool)} stills {EVERY} s apart, fewer than {count - 1}; add motions or ask "
            "for fewer scans"
        )
    pool = pool[random.permutation(len(pool))[: max(5 * count, 50)]]
    poses = np.concatenate([a_pose()[None], pool[_unlike(pool, count - 1)]])
    return placed(poses, body)


def a_pose() -> np.ndarray:
    """Joint rotations (55, 3) [rad] of a person who stands with arms lowered and legs a little apart."""
    pose = np.zeros((JOINT_COUNT, 3))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        pose[JOINT_NAMES.index(f"{side}_shoulder"), 2] = sign * ARMS_DOWN
        pose[JOINT_NAMES.index(f"{side}_hip"), 2] = -sign * np.radians(8.0)
    return pose


def placed(poses: np.ndarray, body: BodyModel) -> PoseSequence:
    """Poses (N, 55, 3) of a body over the origin with its lowest point on y = 0."""
    vertices = body.pose(poses)
    pelvis = body.joints[0]
    transl = np.stack([np.full(len(poses), -pelvis[0]), -vertices[..., 1].min(1), np.full(len(poses), -pelvis[2])], 1)
    return PoseSequence(poses, transl, fps=1.0, source="virtual capture rig", pelvis=pelvis)


def misestimated(poses: PoseSequence, degrees: float, seed: int) -> PoseSequence:
    """Poses as an estimator might give them: each body joint turned by ``degrees`` about a random axis, 3 cm off."""
    random = np.random.default_rng([seed, 3])
    axis = random.normal(size=(len(poses), BODY_JOINT_COUNT, 3))
    axis *= np.radians(degrees) / np.linalg.norm(axis, axis=-1, keepdims=True)
    wrong = poses.poses.copy()
    turned = matrix_from_axis_angle(axis) @ matrix_from_axis_angle(wrong[:, :BODY_JOINT_COUNT])
    wrong[:, :BODY_JOINT_COUNT] = axis_angle_from_matrix(turned)
    wrong[:, BODY_JOINT_COUNT:] = 0  # estimators rarely see fingers
    shift = 0.03 * np.minimum(degrees, 20.0) / 20.0 * random.normal(size=(len(poses), 3)) / np.sqrt(3)
    return replace(poses, poses=wrong, transl=poses.transl + shift)


def _clips(folder: Path | None, seed: int) -> list[PoseSequence]:
    if folder is None:
        return [procedural_motion(seed + i, seconds=30.0) for i in range(3)]
    from caphy.training.motions import find_poses

    return find_poses([folder])


def _stills(clip: PoseSequence) -> np.ndarray:
    return clip.poses[:: max(round(EVERY * clip.fps), 1)]


def _unlike(pool: np.ndarray, count: int) -> np.ndarray:
    """Indices (count,) of poses (N, 55, 3), each farthest from the A-pose and those before it; headings count not."""
    every = matrix_from_axis_angle(np.stack([a_pose(), *pool])[:, 1:BODY_JOINT_COUNT]).reshape(1 + len(pool), -1)
    seen = every[1:]
    chosen, distance = [], np.linalg.norm(seen - every[0], axis=1)
    for _ in range(min(count, len(pool))):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(seen - seen[chosen[-1]], axis=1))
    return np.array(chosen, dtype=int)
