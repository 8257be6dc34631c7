"""A CMU skeleton's motion on the joints of an SMPL-X-format body.

Both skeletons are described by the world rotation of each joint from its own rest pose. For a limb the body's rest
bone is first turned onto the source's rest bone (A, the smallest such turn), then moved as the source moves (G):
the body's joint has world rotation G A, so that every limb points exactly where the source's points. The trunk has
A = 1: upright is upright. For the feet A is the splay of the source's shin against the vertical, so that a foot flat
under a vertical shin stays flat. Root motion is scaled by the ratio of leg lengths and set so that the midpoint of
the hips follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from caphy.conventions import JOINT_COUNT, JOINT_NAMES, JOINT_PARENTS
from caphy.errors import CaphyError
from caphy.io.poses.ground import on_ground
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.skeleton import SkeletonMotion
from caphy.io.retarget_names import cmu_joints
from caphy.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    quaternion_from_matrix,
)

INDEX: Final = {name: index for index, name in enumerate(JOINT_NAMES)}

SOURCES: Final[dict[str, tuple[str, ...]]] = {
    "pelvis": ("root",),
    "spine1": ("lowerback",),
    "spine2": ("upperback",),
    "spine3": ("thorax",),
    "neck": ("lowerneck", "upperneck"),
    "head": ("head",),
    **{
        f"{side}_{joint}": tuple(side[0] + bone for bone in bones)
        for side in ("left", "right")
        for joint, bones in {
            "hip": ("femur",),
            "knee": ("tibia",),
            "ankle": ("foot",),
            "foot": ("toes",),
            "collar": ("clavicle",),
            "shoulder": ("humerus",),
            "elbow": ("radius",),
            "wrist": ("hand",),
        }.items()
    },
}
"""CMU bones whose rotation a joint takes, the mean where there are two: the neck bends at both its joints."""

LIMBS: Final[dict[str, tuple[str, str, str]]] = {
    f"{side}_{joint}": (f"{side}_{child}", side[0] + bone, side[0] + next_bone)
    for side in ("left", "right")
    for joint, child, bone, next_bone in (
        ("hip", "knee", "femur", "tibia"),
        ("knee", "ankle", "tibia", "foot"),
        ("shoulder", "elbow", "humerus", "radius"),
        ("elbow", "wrist", "radius", "wrist"),
    )
}
"""Bones whose direction is carried over: from a joint to its child, and the CMU bone from its start to the next's."""


@dataclass(frozen=True)
class RestBody:
    """What retargeting needs of a body at rest: joints (55, 3) [m] and the height of its soles [m]."""

    joints: np.ndarray
    sole: float


def retarget(motion: SkeletonMotion, body: RestBody) -> PoseSequence:
    """The motion on ``body``, standing on the ground y = 0.

    Raises :class:`CaphyError` for a skeleton that is not CMU's or whose zero pose is not the one its limbs are
    defined by (legs down, left hand on the +x side or arms down).
    """
    bones = cmu_joints(motion)
    rest = _rest_positions(motion)
    world, positions = motion.world()
    alignments = _alignments(bones, rest, body.joints, motion.source)
    turned = np.tile(np.eye(3), (len(world), JOINT_COUNT, 1, 1))
    for joint, parent in enumerate(JOINT_PARENTS):
        names = SOURCES.get(JOINT_NAMES[joint])
        if names is None:
            turned[:, joint] = turned[:, parent]
        else:
            turned[:, joint] = _mean([world[:, bones[name]] for name in names]) @ alignments[joint]
    for side in ("left", "right"):
        _share_twist(turned, joints=(INDEX[f"{side}_elbow"], INDEX[f"{side}_wrist"]), rest=body.joints)
    local = turned.copy()
    for joint, parent in enumerate(JOINT_PARENTS[1:], start=1):
        local[:, joint] = np.swapaxes(turned[:, parent], -1, -2) @ turned[:, joint]
    poses = axis_angle_from_matrix(local)
    scale = _leg_length(body.joints[[INDEX[f"left_{j}"] for j in ("hip", "knee", "ankle")]]) / _leg_length(
        rest[[bones[name] for name in ("lfemur", "ltibia", "lfoot")]]
    )
    sequence = PoseSequence(
        poses=poses,
        transl=_translation(scale, positions, bones, turned[:, 0], body.joints),
        fps=motion.fps,
        source=motion.source,
        pelvis=body.joints[0],
        notes=(
            *motion.notes,
            f"root motion scaled by {scale:.4g} m per unit of the file, the ratio of leg lengths",
            "fingers, jaw and eyes are not in the file and rest",
        ),
    )
    return on_ground(sequence, body.joints, body.sole)


def _rest_positions(motion: SkeletonMotion) -> np.ndarray:
    """Positions (K, 3) of the joints in the zero pose, root at the origin."""
    positions = np.zeros_like(motion.offsets)
    for joint, parent in enumerate(motion.parents[1:], start=1):
        positions[joint] = positions[parent] + motion.offsets[joint]
    return positions


def _alignments(bones: dict[str, int], rest: np.ndarray, joints: np.ndarray, source: str) -> np.ndarray:
    """Turns A (55, 3, 3) of each joint's rest frame of the body onto the source's."""
    turns = np.tile(np.eye(3), (JOINT_COUNT, 1, 1))
    for name, (child, bone, next_bone) in LIMBS.items():
        target = joints[INDEX[child]] - joints[INDEX[name]]
        given = rest[bones[next_bone]] - rest[bones[bone]]
        turns[INDEX[name]] = _smallest_turn(target, given, f"{source}: bone {bone!r}")
    for side in ("left", "right"):
        shin = rest[bones[f"{side[0]}foot"]] - rest[bones[f"{side[0]}tibia"]]
        if (length := float(np.linalg.norm(shin))) > 0 and -shin[1] < 0.5 * length:
            raise CaphyError(
                f"{source}: its shins point {(shin / length).round(2)} in the zero pose, which must stand with legs "
                "down and y up; say which axis is up in the file: --up y or --up z"
            )
        splay = _smallest_turn(np.array([0.0, -1.0, 0.0]), shin, f"{source}: bone '{side[0]}tibia'")
        turns[[INDEX[f"{side}_ankle"], INDEX[f"{side}_foot"]]] = splay
        turns[INDEX[f"{side}_wrist"]] = turns[INDEX[f"{side}_elbow"]]
    return turns


def _smallest_turn(start: np.ndarray, end: np.ndarray, where: str) -> np.ndarray:
    """Rotation (3, 3) of the direction ``start`` onto ``end`` about their common normal."""
    lengths = np.linalg.norm(start), np.linalg.norm(end)
    if min(lengths) < 1e-9:
        raise CaphyError(f"{where} must have a length; the limbs' directions cannot be read from it")
    start, end = start / lengths[0], end / lengths[1]
    if start @ end < -0.5:
        raise CaphyError(
            f"{where} points {end.round(2)} in the zero pose, against {start.round(2)} in a T-pose; "
            "the zero pose must stand with legs down and left side at +x"
        )
    axis, cosine = np.cross(start, end), float(start @ end)
    sine = float(np.linalg.norm(axis))
    return matrix_from_axis_angle(axis * (np.arctan2(sine, cosine) / sine if sine > 1e-12 else 0.0))


def _mean(rotations: list[np.ndarray]) -> np.ndarray:
    """Mean of one or two rotations (T, 3, 3): half way on the shorter arc."""
    if len(rotations) == 1:
        return rotations[0]
    first, second = rotations
    half = axis_angle_from_matrix(np.swapaxes(first, -1, -2) @ second) / 2
    return first @ matrix_from_axis_angle(half)


def _share_twist(turned: np.ndarray, joints: tuple[int, int], rest: np.ndarray) -> None:
    """Give the elbow half of the wrist's twist about the forearm, in place: the radius turns along its length.

    ``turned`` (T, 55, 3, 3) are world rotations; the twist is that of the swing-twist decomposition (Huyghe 2008).
    """
    elbow, wrist = joints
    axis = rest[wrist] - rest[elbow]
    axis = axis / np.linalg.norm(axis)
    between = quaternion_from_matrix(np.swapaxes(turned[:, elbow], -1, -2) @ turned[:, wrist])
    between = np.where(between[:, :1] < 0, -between, between)
    twist = 2 * np.arctan2(between[:, 1:] @ axis, between[:, 0])
    turned[:, elbow] = turned[:, elbow] @ matrix_from_axis_angle(twist[:, None] / 2 * axis)


def _leg_length(joints: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(joints, axis=0), axis=-1).sum())


def _translation(
    scale: float, positions: np.ndarray, bones: dict[str, int], pelvis: np.ndarray, joints: np.ndarray
) -> np.ndarray:
    """Translations (T, 3) that put the midpoint of the body's hips at the source's, scaled."""
    hips = scale * (positions[:, bones["lfemur"]] + positions[:, bones["rfemur"]]) / 2
    middle = (joints[INDEX["left_hip"]] + joints[INDEX["right_hip"]]) / 2
    return hips - pelvis @ (middle - joints[0]) - joints[0]
