"""Quaternions (w first) in plain numpy: :mod:`caphy.rotations` serves tensors too, and is slower on single frames."""

from __future__ import annotations

import numpy as np


def exponential(vectors: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) of rotation vectors (..., 3) [rad]."""
    angle = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None]
    half = np.where(angle > 1e-8, np.sin(angle / 2) / np.maximum(angle, 1e-8), 0.5)
    return np.concatenate([np.cos(angle / 2), half * vectors], axis=-1)


def logarithm(quaternions: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) [rad], at most pi long, of unit quaternions (..., 4)."""
    vector = np.where(quaternions[..., :1] < 0, -1.0, 1.0) * quaternions[..., 1:]
    length = np.sqrt(np.einsum("...i,...i->...", vector, vector))[..., None]
    angle = 2 * np.arctan2(length, np.abs(quaternions[..., :1]))
    return vector * np.where(length > 1e-8, angle / np.maximum(length, 1e-8), 2.0)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of the rotation ``b`` followed by ``a``, both (..., 4)."""
    scalar, vector = a[..., :1], a[..., 1:]
    other, along = b[..., :1], b[..., 1:]
    real = scalar * other - np.einsum("...i,...i->...", vector, along)[..., None]
    x, y, z = (vector[..., i] for i in range(3))
    u, v, w = (along[..., i] for i in range(3))
    cross = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)
    return np.concatenate([real, scalar * along + other * vector + cross], axis=-1)


def between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) [rad] from ``start`` to ``end``, both (..., 4), in the frame of ``start``."""
    return logarithm(product(start * np.array([1.0, -1.0, -1.0, -1.0]), end))


def rotated(start: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) of ``start`` turned by ``vectors`` (..., 3) [rad] in its own frame."""
    turned = product(start, exponential(vectors))
    return turned / np.sqrt(np.einsum("...i,...i->...", turned, turned))[..., None]


def turned(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """The vector (3,) turned by the unit quaternion (4,)."""
    w, x, y, z = quaternion.tolist()
    a, b, c = vector.tolist()
    u, v, r = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return np.array([a + w * u + y * r - z * v, b + w * v + z * u - x * r, c + w * r + x * v - y * u])


def aligning(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The shortest rotation (4,) that takes the unit vector ``start`` (3,) to ``end`` (3,)."""
    quaternion = np.array([1 + start @ end, *np.cross(start, end)])
    length = np.linalg.norm(quaternion)
    if length < 1e-6:  # opposite: half a turn about anything across
        across = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
        return np.array([0.0, *(across / np.linalg.norm(across))])
    return quaternion / length


def heading(quaternions: np.ndarray) -> np.ndarray:
    """The turn about y (..., 4) that faces where a body of root rotation ``quaternions`` (..., 4) faces.

    That is the twist about y of the rotation (Dobrowolski 2015); where it is undefined, no turn.
    """
    twist = quaternions * np.array([1.0, 0.0, 1.0, 0.0])
    length = np.sqrt(np.einsum("...i,...i->...", twist, twist))[..., None]
    return np.where(length > 1e-6, twist / np.maximum(length, 1e-6), np.array([1.0, 0.0, 0.0, 0.0]))
