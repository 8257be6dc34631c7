"""Rotation vectors and matrices, many at once and nothing else: this runs several times for every picture."""

from __future__ import annotations

import numpy as np


def turns(vectors: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of axis-angle vectors (N, 3) [rad]."""
    angle = np.sqrt(np.einsum("nc,nc->n", vectors, vectors)) + 1e-12
    x, y, z = (vectors / angle[:, None]).T
    s, c = np.sin(angle), np.cos(angle)
    v = 1 - c
    entries = [c + v * x * x, v * x * y - s * z, v * x * z + s * y, v * x * y + s * z, c + v * y * y]
    entries += [v * y * z - s * x, v * x * z - s * y, v * y * z + s * x, c + v * z * z]
    return np.stack(entries, axis=-1).reshape(-1, 3, 3)


def turns_inverse(rotations: np.ndarray) -> np.ndarray:
    """Axis-angle vectors (N, 3) [rad] of rotation matrices (N, 3, 3) that turn by less than half a turn."""
    skew = np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        axis=-1,
    )
    sine = np.sqrt(np.einsum("nc,nc->n", skew, skew)) / 2
    cosine = (np.trace(rotations, axis1=1, axis2=2) - 1) / 2
    angle = np.arctan2(sine, cosine)
    return skew * np.where(sine > 1e-6, angle / (2 * sine + 1e-30), 0.5)[:, None]


def inverse_jacobians(vectors: np.ndarray) -> np.ndarray:
    """How axis-angle vectors (N, 3) move when a small turn is multiplied from the right, (N, 3, 3).

    Sola, Deray and Atchuthan, "A micro Lie theory" (2018), eq. 144.
    """
    angle = np.sqrt(np.einsum("nc,nc->n", vectors, vectors)).clip(1e-4, 3.1)
    factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    skew = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -z, y, -x
    skew[:, 1, 0], skew[:, 2, 0], skew[:, 2, 1] = z, -y, x
    return np.eye(3) + skew / 2 + factor[:, None, None] * (skew @ skew)


def smallest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of the direction ``start`` (3,) onto ``end`` about their common normal."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, start @ end))
    return turns((axis * (angle / sine if sine > 1e-9 else 0.0))[None])[0]


def best_turn(points: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) that carries ``points`` (N, 3) nearest to ``targets`` (N, 3), both about their weighted means.

    Kabsch (1976).
    """
    share = weights / weights.sum()
    points, targets = points - share @ points, targets - share @ targets
    u, _, vt = np.linalg.svd((targets * share[:, None]).T @ points)
    u[:, 2] *= np.sign(np.linalg.det(u @ vt))
    return u @ vt
