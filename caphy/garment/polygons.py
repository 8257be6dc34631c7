"""Polygons of a mesh cut into triangles: as a fan where that is well, else ear by ear."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

LEAST = 1e-3
"""Signed area over longest side squared below which a triangle of a fan is folded over or a sliver; of a square's half
it is a quarter."""

Corners = tuple[int, int, int]


def triangles(points: np.ndarray, polygons: Sequence[Sequence[int]]) -> list[list[Corners]]:
    """For each polygon of points (V, 3) the places of its triangles' corners in it, wound as it is; an empty list where
    it cannot be cut, as where it crosses itself.

    Ears are clipped as in Meisters, Polygons have ears (American Mathematical Monthly 82, 1975), the best shaped first.
    """
    cut: list[list[Corners]] = [[] for _ in polygons]
    count = np.array([len(polygon) for polygon in polygons])
    for size in np.unique(count).tolist():
        which = np.flatnonzero(count == size)
        corners = points[np.array([polygons[i] for i in which.tolist()])]
        fan = [(0, k, k + 1) for k in range(1, size - 1)]
        good = np.ones(len(which), bool) if size == 3 else _fans(corners, fan)
        for i, polygon, well in zip(which.tolist(), corners, good, strict=True):
            cut[i] = fan if well else _ears(_flat(polygon))
    return cut


def _normals(corners: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3) of polygons (N, K, 3) by Newell's sum; zero without area."""
    centred = corners - corners.mean(axis=1, keepdims=True)
    total = np.cross(centred, np.roll(centred, -1, axis=1)).sum(axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def _fans(corners: np.ndarray, fan: list[Corners]) -> np.ndarray:
    """Whether all triangles of each polygon's (N, K, 3) fan are well shaped (N,)."""
    triangle = corners[:, np.array(fan)]
    a, b, c = np.moveaxis(triangle, 2, 0)
    area = 0.5 * np.einsum("nkc,nc->nk", np.cross(b - a, c - a), _normals(corners))
    longest = np.max([((b - a) ** 2).sum(-1), ((c - b) ** 2).sum(-1), ((a - c) ** 2).sum(-1)], axis=0)
    return (area > LEAST * longest).all(axis=1)


def _flat(polygon: np.ndarray) -> np.ndarray:
    """A polygon's corners (K, 3) in its own plane (K, 2), counter-clockwise."""
    (normal,) = _normals(polygon[None])
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    side /= max(float(np.linalg.norm(side)), 1e-300)
    return polygon @ np.stack([side, np.cross(normal, side)], axis=1)


def _ears(flat: np.ndarray) -> list[Corners]:
    """Triangles of a polygon (K, 2)."""
    left, found = list(range(len(flat))), []
    while len(left) >= 3:
        ears = [(left[at - 1], left[at], left[(at + 1) % len(left)]) for at in range(len(left))]
        shaped = [(_shape(flat[list(ear)]), at) for at, ear in enumerate(ears)]
        clear = (at for shape, at in sorted(shaped, reverse=True) if shape > 0 and _is_empty(flat, ears[at], left))
        if (at := next(clear, None)) is None:
            return []
        found.append(ears[at])
        if len(left) == 3:
            return found
        del left[at]
    return []


def _shape(corners: np.ndarray) -> float:
    """Signed area over longest side squared of a triangle (3, 2)."""
    (ax, ay), (bx, by), (cx, cy) = corners
    longest = ((np.roll(corners, -1, axis=0) - corners) ** 2).sum(axis=1).max()
    return float(0.5 * ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / max(longest, 1e-300))


def _is_empty(flat: np.ndarray, ear: Corners, left: list[int]) -> bool:
    """Whether no other corner lies in an ear or on its sides, but for rounding."""
    others = flat[[i for i in left if i not in ear]]
    inside = np.ones(len(others), bool)
    for i, j in zip(ear, (*ear[1:], ear[0]), strict=True):
        side = flat[j] - flat[i]
        beside = side[0] * (others[:, 1] - flat[i, 1]) - side[1] * (others[:, 0] - flat[i, 0])
        inside &= beside >= -1e-6 * (side @ side)
    return not inside.any()
