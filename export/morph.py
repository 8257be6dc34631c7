"""A garment's motion as blend shapes: what is left after skinning, in few components."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from caphy.body.skinning import blend_transforms, skin
from caphy.io.bundle import SkinnedMesh
from caphy.report.render import vertex_normals

DAMPING = 1e-6
"""Ridge of the inverse of blended transforms: keeps offsets finite where a twist by half a turn flattens them."""


@dataclass(frozen=True, eq=False)
class Morph:
    """Canonical positions base + sum_k weights[t, k] targets[k], and normals alike.

    base, base_normals: (V, 3). targets, target_normals: (R, V, 3). weights: (T, R), at most one in size.
    error: largest distance of a posed vertex from where it should be [m].
    """

    base: np.ndarray
    base_normals: np.ndarray
    targets: np.ndarray
    target_normals: np.ndarray
    weights: np.ndarray
    error: float


def unskin(blended: np.ndarray, posed: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Canonical points (T, V, 3) that ``blended`` (T, V, 3, 4) carries to ``posed`` (T, V, 3).

    Damped least squares around ``rest`` (V, 3): where transforms are well conditioned it is their inverse.
    """
    linear = blended[..., :3]
    transposed = np.swapaxes(linear, -1, -2)
    gap = posed - skin(blended, np.broadcast_to(rest, posed.shape))
    offset = np.linalg.solve(transposed @ linear + DAMPING * np.eye(3), transposed @ gap[..., None])
    return rest + offset[..., 0]


def motion_morph(mesh: SkinnedMesh, transforms: np.ndarray, posed: np.ndarray, tolerance: float) -> Morph:
    """The fewest blend shapes that keep every vertex within ``tolerance`` [m].

    Args:
        mesh: the garment in T-pose.
        transforms: skinning transforms of the joints, (T, 55, 3, 4), ``transl`` included.
        posed: vertices the garment should have, (T, V, 3) [m].
        tolerance: largest distance of a vertex [m].
    """
    weights = mesh.dense_weights()
    rest = mesh.vertices.astype(np.float64)
    blended = [blend_transforms(weights, part) for part in np.array_split(transforms, -(-len(transforms) // 32))]
    parts = np.array_split(posed.astype(np.float64), len(blended))
    canonical = np.concatenate([unskin(b, p, rest) for b, p in zip(blended, parts, strict=True)])
    base = canonical.mean(axis=0)
    components, amounts = _principal_components((canonical - base).reshape(len(posed), -1))

    def error(rank: int) -> float:
        points = base + (amounts[:, :rank] @ components[:rank]).reshape(posed.shape)
        split = np.array_split(points, len(blended))
        return max(
            float(np.linalg.norm(skin(b, p) - q, axis=-1).max()) for b, p, q in zip(blended, split, parts, strict=True)
        )

    rank = _smallest(len(components), lambda r: error(r) <= tolerance)
    normals = np.stack([vertex_normals(points, mesh.faces) for points in canonical])
    base_normals = normals.mean(axis=0)
    base_normals /= np.linalg.norm(base_normals, axis=-1, keepdims=True) + 1e-12
    return _scaled(
        base,
        base_normals,
        components=components[:rank],
        amounts=amounts[:, :rank],
        normals=normals,
        error=error(rank),
    )


def _principal_components(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal components (R, 3V) and their amounts (T, R) of offsets (T, 3V), by the T x T Gram matrix."""
    values, vectors = np.linalg.eigh(offsets @ offsets.T)
    keep = np.argsort(-values)[: np.count_nonzero(values > 1e-14 * max(values.max(), 1e-12))]
    singular = np.sqrt(values[keep])
    return (vectors[:, keep] / singular).T @ offsets, vectors[:, keep] * singular


def _smallest(most: int, good: Callable[[int], bool]) -> int:
    """The smallest number up to ``most`` that is good, where larger ones are better; by bisection."""
    low, high = 0, most
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if good(middle) else (middle + 1, high)
    return high


def _scaled(
    base: np.ndarray,
    base_normals: np.ndarray,
    *,
    components: np.ndarray,
    amounts: np.ndarray,
    normals: np.ndarray,
    error: float,
) -> Morph:
    """Blend shapes with weights at most one, and the normals' own by ridge regression on the same weights."""
    size = np.abs(amounts).max(axis=0) if amounts.size else np.ones(amounts.shape[1])
    size = np.where(size > 0, size, 1)
    weights = amounts / size
    ridge = 1e-4 * len(weights) * np.eye(weights.shape[1])
    change = (normals - base_normals).reshape(len(normals), -1)
    target_normals = np.linalg.solve(weights.T @ weights + ridge, weights.T @ change)
    shape = (len(components), *base.shape)
    targets = (components * size[:, None]).reshape(shape)
    return Morph(base, base_normals, targets, target_normals.reshape(shape), weights, error)
