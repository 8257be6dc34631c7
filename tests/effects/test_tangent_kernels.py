"""The positive part of 3x3 tangents, against LAPACK's eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.effects.tangent_kernels import positive_tangents

ROWS, COLUMNS = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


def whole(entries: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) of their entries (6, n)."""
    found = np.empty((entries.shape[1], 3, 3))
    found[:, ROWS, COLUMNS] = found[:, COLUMNS, ROWS] = entries.T
    return found


def by_lapack(entries: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(whole(entries))
    return (vectors * np.maximum(values, 0)[:, None, :]) @ vectors.transpose(0, 2, 1)


def drawn(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(6, 400))


@pytest.mark.parametrize(
    "entries",
    [
        drawn(0),
        drawn(1) * [[1], [1e-6], [1e6], [1e-3], [1], [1e3]],  # far apart
        drawn(2) * [[1], [1], [1], [0], [0], [0]],  # diagonal
        np.vstack([np.ones((3, 400)), 1e-9 * drawn(3)[3:]]),  # all but equal eigenvalues
        np.vstack([-np.ones((3, 400)), 1e-9 * drawn(4)[3:]]),
        np.vstack([drawn(5)[:1] * np.ones((6, 1))]),  # of rank one
        np.zeros((6, 3)),
        drawn(6) * 1e-30,
    ],
)
def test_negative_eigenvalues_are_left_out(entries):
    entries = np.ascontiguousarray(entries, dtype=float)
    found = np.empty_like(entries)
    positive_tangents(entries, found)
    np.testing.assert_allclose(whole(found), by_lapack(entries), rtol=0, atol=2e-14 * np.abs(entries).max() + 1e-300)


def test_what_has_none_stays_as_it_is():
    factors = np.random.default_rng(7).normal(size=(50, 3, 3))
    definite = factors @ factors.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    entries = np.ascontiguousarray(definite[:, ROWS, COLUMNS].T)
    found = np.empty_like(entries)
    positive_tangents(entries, found)
    np.testing.assert_array_equal(found, entries)
