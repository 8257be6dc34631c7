"""What is solved for does not depend on the units in which numbers are given."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.refit.evidence import bounded, ridged

UNITS = np.array([1e-8, 1.0, 1e3, 1e7])
"""A bending's viscosity [N m s], a relative change, a stiffness [N/m] and a contact's [N/m^4], each about one."""


@pytest.fixture
def form() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    rows = random.normal(size=(30, 4))
    return rows.T @ rows, rows.T @ random.normal(size=30)


@pytest.mark.parametrize("ridge", [0.0, 1e-3, 0.3])
def test_a_stiffness_counts_beside_a_viscosity(form, ridge):
    normal, right = form
    told = ridged(normal / np.outer(UNITS, UNITS), right / UNITS, ridge)
    np.testing.assert_allclose(told / UNITS, np.linalg.solve(normal + ridge * np.diag(np.diag(normal)), right))


def test_within_bounds_too(form):
    normal, right = form
    told = bounded(normal / np.outer(UNITS, UNITS), right / UNITS, -np.full(4, np.inf), np.full(4, np.inf))
    np.testing.assert_allclose(told / UNITS, np.linalg.solve(normal, right), rtol=1e-6)


def test_what_does_nothing_is_none():
    normal, right = np.diag([4.0, 0.0, 2.0]), np.array([2.0, 0.0, 1.0])
    np.testing.assert_array_equal(ridged(normal, right, 0.0), [0.5, 0.0, 0.5])
    np.testing.assert_array_equal(ridged(np.zeros((0, 0)), np.zeros(0), 0.1), [])
