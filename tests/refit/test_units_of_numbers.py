"""What is solved for does not depend on the units in which numbers are given."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.diagnose.groups import Group
from caphy.diagnose.screen import screened
from caphy.effects.model import Model
from caphy.refit.columns import addition
from caphy.refit.evidence import Evidence, bounded, ridged
from caphy.refit.intervals import half_widths

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


def windows(units: np.ndarray) -> Evidence:
    """Fifteen windows, of which two know of the first number, in some units."""
    random = np.random.default_rng(1)
    s = random.normal(size=(15, 40, len(units)))
    s[2:, :, 0] *= 1e-3
    e = s.sum(-1) + random.normal(size=(15, 40))
    a, b = np.einsum("wek,wel->wkl", s, s), np.einsum("wek,we->wk", s, e)
    return Evidence(a / np.outer(units, units), b / units, (e * e).sum(1), np.ones(15), np.full(15, 40))


def test_nor_does_how_sure_they_are():
    """Two windows decide on the first, whatever the second's unit."""
    plain, told = windows(np.ones(2)), windows(UNITS[[3, 0]])
    np.testing.assert_allclose(half_widths(told, 0.0)[0] / UNITS[[3, 0]], half_widths(plain, 0.0)[0], rtol=1e-6)


def test_nor_what_an_explanation_gains():
    free, model = Group("of_mine", (*addition("pressure"), *addition("uniform_acceleration")[:1])), Model(0.2)
    (plain,), (told,) = (
        screened(windows(units), [free], {free.label: [0, 1]}, model) for units in (np.ones(2), np.array([1.0, 1e-7]))
    )
    assert told.wald == pytest.approx(plain.wald) and told.gain == pytest.approx(plain.gain)
    assert plain.wald > 100


def test_what_does_nothing_is_none():
    normal, right = np.diag([4.0, 0.0, 2.0]), np.array([2.0, 0.0, 1.0])
    np.testing.assert_array_equal(ridged(normal, right, 0.0), [0.5, 0.0, 0.5])
    np.testing.assert_array_equal(ridged(np.zeros((0, 0)), np.zeros(0), 0.1), [])
