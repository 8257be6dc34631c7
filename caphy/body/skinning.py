"""Linear blend skinning, for numpy arrays and torch tensors alike."""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace

Array = Any
"""A numpy array or a torch tensor."""


def blend_transforms(weights: Array, transforms: Array) -> Array:
    """Per-vertex transforms (..., V, 3, 4): weights (V, J) times transforms (..., J, 3, 4), as one GEMM.

    All frames go into one (frames * 12, J) @ (J, V) product. Its result keeps vertices in the fastest axis, which is
    what :func:`skin` streams through; the (..., V, 3, 4) array returned is a view of it.
    """
    xp = array_namespace(transforms)
    *batch, joints, _, _ = transforms.shape
    planes = xp.moveaxis(xp.reshape(transforms, (*batch, joints, 12)), -2, -1)
    blended = xp.reshape(planes, (-1, joints)) @ weights.T
    return xp.moveaxis(xp.reshape(blended, (*batch, 3, 4, weights.shape[0])), -1, -3)


def skin(blended: Array, points: Array) -> Array:
    """Posed points (..., V, 3) of per-vertex transforms (..., V, 3, 4) and rest points (..., V, 3) [m]."""
    x, y, z = points[..., 0, None], points[..., 1, None], points[..., 2, None]
    return blended[..., 0] * x + blended[..., 1] * y + blended[..., 2] * z + blended[..., 3]
