"""Forward kinematics of a joint tree, batched by tree depth, for numpy arrays and torch tensors alike."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

from array_api_compat import array_namespace

Array = Any
"""A numpy array or a torch tensor."""


@lru_cache(maxsize=16)
def _levels(parents: tuple[int, ...]) -> tuple[tuple[list[int], list[int]], ...]:
    """Per tree depth below the root: the joints, and the places of their parents in the level above."""
    levels, above = [], [0]
    while True:
        joints = [j for j, parent in enumerate(parents) if parent in above and j != 0]
        if not joints:
            return tuple(levels)
        levels.append((joints, [above.index(parents[j]) for j in joints]))
        above = joints


def joint_transforms(rotations: Array, joints: Array, parents: Iterable[int]) -> Array:
    """Skinning transforms (..., J, 3, 4) that carry rest-pose points to posed ones.

    Column 3 is the translation ``t = p - R j`` of world rotation ``R``, rest joint ``j`` and posed joint ``p``. The
    root turns about its own rest position, as SMPL-X does (Loper et al., SIGGRAPH Asia 2015, eq. 3 and 4).

    Args:
        rotations: rotation of each joint against its parent, (..., J, 3, 3).
        joints: rest positions [m], (J, 3) or (..., J, 3).
        parents: parent of each joint, (J,); the first joint is the only root.
    """
    xp = array_namespace(rotations)
    tree = tuple(int(parent) for parent in parents)
    world, position = [rotations[..., :1, :, :]], [_expand(xp, joints[..., :1, :], rotations)]
    order = [0]
    for level, places in _levels(tree):
        parent_rotation = world[-1][..., places, :, :]
        offset = (joints[..., level, :] - joints[..., [tree[j] for j in level], :])[..., None]
        position.append(position[-1][..., places, :] + (parent_rotation @ offset)[..., 0])
        world.append(parent_rotation @ rotations[..., level, :, :])
        order += level
    back = sorted(range(len(order)), key=order.__getitem__)
    rotation = xp.concat(world, axis=-3)[..., back, :, :]
    posed = xp.concat(position, axis=-2)[..., back, :]
    translation = posed - (rotation @ joints[..., None])[..., 0]
    return xp.concat([rotation, translation[..., None]], axis=-1)


def _expand(xp: Any, root: Array, rotations: Array) -> Array:
    return xp.broadcast_to(root, (*rotations.shape[:-3], 1, 3))


def joint_positions(transforms: Array, joints: Array) -> Array:
    """Posed joint positions (..., J, 3) [m] of skinning transforms (..., J, 3, 4) and rest joints (J, 3)."""
    return (transforms[..., :3] @ joints[..., None])[..., 0] + transforms[..., 3]
