"""Normals of vertices that move, in numpy: they are only computed where a client asks for them."""

from __future__ import annotations

import numpy as np


class VertexNormals:
    """Area-weighted normals of a triangle mesh (F, 3) with ``count`` vertices (Gouraud 1971, weighted by area).

    Faces around a vertex are summed by one reduction over corners in the vertices' order; what no face touches, and
    what has no area, gets a zero normal.
    """

    def __init__(self, faces: np.ndarray, count: int) -> None:
        self._faces = np.asarray(faces, np.intp)
        corners = self._faces.ravel()
        order = np.argsort(corners, kind="stable")
        self._face_of_corner = order // 3
        self._used, self._starts = np.unique(corners[order], return_index=True)
        self._count = count

    def __call__(self, vertices: np.ndarray) -> np.ndarray:
        """Unit normals (T, V, 3) float32 of vertices (T, V, 3)."""
        return np.stack([self._frame(frame) for frame in vertices]) if len(vertices) else np.zeros_like(vertices)

    def _frame(self, vertices: np.ndarray) -> np.ndarray:
        a, b, c = (vertices[self._faces[:, i]].T for i in range(3))
        u, v = b - a, c - a
        area = np.empty((3, len(self._faces)), np.float32)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            area[i] = u[j] * v[k] - u[k] * v[j]
        total = np.add.reduceat(area[:, self._face_of_corner], self._starts, axis=1)
        length = np.sqrt((total * total).sum(axis=0))
        normals = np.zeros((self._count, 3), np.float32)
        normals[self._used] = (total / np.maximum(length, np.finfo(np.float32).tiny)).T
        return normals
