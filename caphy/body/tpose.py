"""Turning a body at rest in an A-pose into one at rest in SMPL-X's T-pose."""

from __future__ import annotations

import numpy as np

from caphy.body.kinematics import joint_positions, joint_transforms
from caphy.body.skinning import blend_transforms
from caphy.conventions import JOINT_NAMES, JOINT_PARENTS
from caphy.rotations import matrix_from_axis_angle

COLLAR_LIFT = np.radians(8)
"""How far lifting the arms from the A-pose (45 degrees) lifts the collar bones: the shoulder girdle takes part."""

THIGH = np.array([0.0343, -0.3752, -0.0045])
SHANK = np.array([-0.0136, -0.3980, -0.0437])
"""Left leg of SMPL's T-pose [m], whose directions make a pose mean the same on both bodies."""

_INDEX = {name: i for i, name in enumerate(JOINT_NAMES)}
_DOWN, _FORWARD = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def tpose(vertices: np.ndarray, joints: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and joints (55, 3) in the T-pose, pelvis at the origin, from those of an A-pose [m].

    The vertices are *un*-skinned: blend skinning of the result back into the A-pose gives the given surface exactly,
    so the body is best in the poses people are in most, arms down.
    """
    world = _rotations_to_tpose(joints)
    local = world.copy()
    for joint, parent in enumerate(JOINT_PARENTS[1:], start=1):
        local[joint] = world[parent].T @ world[joint]
    transforms = joint_transforms(local, joints, JOINT_PARENTS)
    back = np.linalg.inv(blend_transforms(weights, _inverse(transforms))[..., :3])
    shift = blend_transforms(weights, _inverse(transforms))[..., 3]
    posed_joints = joint_positions(transforms, joints)
    posed = (back @ (vertices - shift)[..., None])[..., 0]
    return posed - posed_joints[0], posed_joints - posed_joints[0]


def _inverse(transforms: np.ndarray) -> np.ndarray:
    rotation = np.swapaxes(transforms[..., :3], -1, -2)
    return np.concatenate([rotation, -(rotation @ transforms[..., 3:])], axis=-1)


def _rotations_to_tpose(joints: np.ndarray) -> np.ndarray:
    """World rotation (55, 3, 3) of each joint from the A-pose to the T-pose."""
    world = np.tile(np.eye(3), (len(JOINT_NAMES), 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        at = {name: joints[_INDEX[f"{side}_{name}"]] for name in _LIMBS}
        outward = np.array([sign, 0.0, 0.0])
        upper, fore = at["elbow"] - at["shoulder"], at["wrist"] - at["elbow"]
        hinge = np.cross(upper, fore)  # elbows bend forwards: about -y on the left, +y on the right
        hand, across = at["middle1"] - at["wrist"], at["index1"] - at["pinky1"]
        turns = {
            "collar": matrix_from_axis_angle(np.array([0.0, 0.0, sign * COLLAR_LIFT])),
            "shoulder": _turn(upper, hinge, outward, sign * _DOWN),
            "elbow": _turn(fore, hinge, outward, sign * _DOWN),
            "wrist": _turn(hand, across, outward, _FORWARD),
            "hip": _shortest_turn(at["knee"] - at["hip"], THIGH * (sign, 1, 1)),
            "knee": _shortest_turn(at["ankle"] - at["knee"], SHANK * (sign, 1, 1)),
        }
        for name, turn in turns.items():
            world[_INDEX[f"{side}_{name}"]] = turn
        for finger in ("index", "middle", "pinky", "ring", "thumb"):
            for i in (1, 2, 3):
                world[_INDEX[f"{side}_{finger}{i}"]] = turns["wrist"]
    return world


_LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist", "index1", "middle1", "pinky1")


def _turn(axis: np.ndarray, side: np.ndarray, new_axis: np.ndarray, new_side: np.ndarray) -> np.ndarray:
    """Rotation that takes direction ``axis`` to ``new_axis``, and ``side`` as near to ``new_side`` as it can."""
    return _frame(new_axis, new_side) @ _frame(axis, side).T


def _frame(axis: np.ndarray, side: np.ndarray) -> np.ndarray:
    first = axis / np.linalg.norm(axis)
    third = side - (side @ first) * first
    third = third / np.linalg.norm(third)
    return np.stack([first, np.cross(third, first), third], axis=1)


def _shortest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotation by the smallest angle that takes direction ``start`` to ``end``."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, start @ end)
    return matrix_from_axis_angle(axis / max(sine, 1e-12) * angle)
