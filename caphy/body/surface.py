"""Signed distance to a closed triangle surface: exact nearest points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from caphy.errors import CaphyError

Array = Any
"""A numpy array or a torch tensor."""

_LEAF_FACES = 2


class NearestPoints(NamedTuple):
    """For each of N query points, the nearest point of a surface."""

    face: Array
    """Face it lies on, (N,)."""
    barycentric: Array
    """Its weights on that face's corners, (N, 3)."""
    point: Array
    """Its position [m], (N, 3)."""
    normal: Array
    """Outward unit normal: the gradient of the signed distance, (N, 3)."""
    distance: Array
    """Signed distance [m], negative inside, (N,)."""


@dataclass(frozen=True, eq=False)
class Surface:
    """The faces of a surface whose vertices move, ready for nearest-point queries.

    Made once per topology; a query refits its bounding volumes to the vertices it is given, so it is exact for any
    motion, and fast as long as neighbouring faces stay near each other. Needs numba (``caphy[train]``).
    """

    faces: np.ndarray
    """Triangles (F, 3), counter-clockwise seen from outside."""
    order: np.ndarray
    """Faces in the order of the tree's leaves, (F,)."""
    bounds: np.ndarray
    """First place in ``order`` of each leaf, (L + 1,)."""
    neighbours: np.ndarray
    """Face across the edge opposite to each corner, or -1, (F, 3)."""
    starts: np.ndarray
    """First place in ``incident`` of each vertex, (V + 1,)."""
    incident: np.ndarray
    """Corners (3 * face + corner) around each vertex, (3 F,)."""

    @classmethod
    def of(cls, faces: np.ndarray, vertices: np.ndarray) -> Surface:
        """Prepare ``faces`` (F, 3); ``vertices`` (V, 3), any pose, decide how they are grouped.

        Raises:
            CaphyError: there are no faces, or they do not index the vertices.
        """
        from caphy.body.triangle_tree import build_order

        faces = np.ascontiguousarray(faces, dtype=np.int64)
        if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise CaphyError(f"a surface needs triangles (F, 3), got shape {faces.shape}")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise CaphyError(f"faces must index {len(vertices)} vertices, got {faces.min()} to {faces.max()}")
        leaves = 1 << max(len(faces) // _LEAF_FACES, 1).bit_length() - 1
        order, bounds = build_order(np.asarray(vertices, dtype=np.float64)[faces].mean(axis=1), leaves)
        corners = np.argsort(faces.ravel(), kind="stable")
        starts = np.searchsorted(faces.ravel()[corners], np.arange(len(vertices) + 1))
        return cls(faces, order, bounds, _neighbours(faces), starts, corners)

    def nearest(self, points: np.ndarray, vertices: np.ndarray, guess: np.ndarray | None = None) -> NearestPoints:
        """Nearest surface points of ``points`` (N, 3) [m], the surface's vertices being at ``vertices`` (V, 3).

        Args:
            guess: faces (N,) expected to be near, such as those of the frame before. They cannot change the answer,
                only the time it takes.

        Raises:
            CaphyError: a coordinate is not finite.
        """
        from caphy.body.triangle_tree import query, refit

        points = np.ascontiguousarray(points, dtype=np.float64)
        vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        if not (np.isfinite(points).all() and np.isfinite(vertices).all()):
            raise CaphyError("nearest points need finite coordinates, got NaN or infinity")
        low, high = np.empty((2, 2 * (len(self.bounds) - 1), 3))
        refit(vertices, self.faces, self.order, self.bounds, low, high)
        guess = np.full(len(points), -1) if guess is None else np.asarray(guess, dtype=np.int64)
        topology = (self.neighbours, self.starts, self.incident)
        tree = (self.faces, self.order, self.bounds, low, high)
        return NearestPoints(*query(points, vertices, *tree, *topology, guess))


def nearest_on_surface(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> NearestPoints:
    """Nearest surface points of ``points`` (N, 3) [m] on one mesh; keep a :class:`Surface` for repeated queries."""
    return Surface.of(faces, vertices).nearest(points, vertices)


def _neighbours(faces: np.ndarray) -> np.ndarray:
    """Face across the edge opposite to each corner, or -1, (F, 3)."""
    edges = np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1).reshape(-1, 2)
    key = np.sort(edges, axis=1) @ np.array([faces.max() + 1, 1])
    order = np.argsort(key, kind="stable")
    paired = np.flatnonzero(key[order][1:] == key[order][:-1])
    neighbours = np.full(len(edges), -1)
    neighbours[order[paired]] = order[paired + 1] // 3
    neighbours[order[paired + 1]] = order[paired] // 3
    return neighbours.reshape(-1, 3)
