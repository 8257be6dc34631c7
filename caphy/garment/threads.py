"""Thread directions and the rest metric: each triangle laid flat with warp along the garment's length."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, diags

from caphy.garment import topology


def warp_field(vertices: np.ndarray, faces: np.ndarray, guide: np.ndarray, rounds: int = 60) -> np.ndarray:
    """Smooth unit tangents (F, 3) that follow ``guide`` (F, 3) where it lies in the surface.

    Warp is a line, not an arrow: a thread that runs up the chest and down the back is one thread. So the lines are
    smoothed through their projectors d d^T, held to the guide in proportion to its squared tangential length,
    and only at the end given the sense of the guide.
    """
    normals = topology.face_normals(vertices, faces)
    tangent = guide - normals * (guide * normals).sum(1, keepdims=True)
    held = np.clip((tangent**2).sum(1), 0.0, 1.0)
    target = tangent[:, :, None] * tangent[:, None, :]
    flat = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    average = neighbour_average(topology.hinge_faces(faces), len(faces))
    lines = target
    for _ in range(rounds):
        blurred = (average @ lines.reshape(-1, 9)).reshape(-1, 3, 3)
        lines = target + (1.0 - held)[:, None, None] * (flat @ blurred @ flat)
    direction = np.linalg.eigh(lines)[1][:, :, 2]
    direction -= normals * (direction * normals).sum(1, keepdims=True)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.where((direction * guide).sum(1, keepdims=True) < 0, -direction, direction)


def neighbour_average(pairs: np.ndarray, count: int):
    """Sparse matrix (count, count) that replaces each node by the mean of its neighbours under ``pairs`` (N, 2)."""
    row, column = np.concatenate([pairs, pairs[:, ::-1]]).T
    adjacency = coo_matrix((np.ones(len(row)), (row, column)), shape=(count, count)).tocsr()
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    return diags(1.0 / np.maximum(degree, 1.0)) @ adjacency


def lay_flat(vertices: np.ndarray, faces: np.ndarray, warp: np.ndarray) -> np.ndarray:
    """Material coordinates (F, 3, 2) [m]: each triangle turned rigidly into its plane, weft = u, ``warp`` (F, 3) = v.

    The first corner is the origin; areas are positive and edge lengths are those of the 3-D mesh.
    """
    normals = topology.face_normals(vertices, faces)
    weft = np.cross(warp, normals)
    corner = vertices[faces] - vertices[faces][:, :1]
    return np.stack([np.einsum("fkd,fd->fk", corner, weft), np.einsum("fkd,fd->fk", corner, warp)], axis=-1)
