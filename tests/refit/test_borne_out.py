"""A fit goes on where tangents explode in all windows at once, though they say that it has arrived."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.refit.columns import Column
from caphy.refit.evidence import Evidence, borne_out, bounded
from caphy.refit.responses import Response
from caphy.refit.study import Study

TRUTH, RIPPLE, QUICK = 3.0, 0.02, 200.0
"""Of one number; cloth that wrinkles, by little, but anew with its every small change."""


def wrinkled(number: float, ripple: float = RIPPLE, windows: int = 15) -> Evidence:
    """Windows of 40 entries that follow a number evenly, but for ripples that only their tangents know much of."""
    random = np.random.default_rng(0)
    even, phase = random.normal(size=(2, windows, 40))

    def along(at: float) -> np.ndarray:
        return even * at + ripple * np.sin(QUICK * max(at - 0.5, 0) + 3 * phase)

    residual = along(TRUTH) - along(number)
    tangent = even + (ripple * QUICK * np.cos(QUICK * (number - 0.5) + 3 * phase) if number > 0.5 else 0)
    ones = np.ones(windows)
    return Evidence(
        (tangent**2).sum(1)[:, None, None], (tangent * residual).sum(1)[:, None], (residual**2).sum(1), ones, ones
    )


def fitted(ripple: float, mended: bool, steps: int = 4) -> float:
    first, number = wrinkled(0.0, ripple), 0.0
    number += 0.4 * float(bounded(*first.normal, np.array([-9.0]), np.array([9.0]))[0])
    for _ in range(steps):
        known, change = wrinkled(number, ripple), np.array([number])
        known = borne_out(known, first, change, change) if mended else known
        number += float(bounded(*known.normal, np.array([-9.0]), np.array([9.0]))[0])
    return number


def test_a_fit_amid_wrinkles_arrives() -> None:
    assert fitted(RIPPLE, mended=False) < 2.4
    assert fitted(RIPPLE, mended=True) == pytest.approx(TRUTH, rel=0.02)


def test_where_slopes_fall_as_curvatures_say_nothing_changes() -> None:
    known, change = wrinkled(2.0, 0.0), np.array([2.0])
    assert borne_out(known, wrinkled(0.0, 0.0), change, change) is known


def test_a_number_whose_curvature_has_not_grown_keeps_it() -> None:
    """Two numbers, of which one explodes; the other is relative, and doubles: its unit at the end is twice as large."""
    first = Evidence(
        np.array([[[1.0, 0.1], [0.1, 1.0]]]), np.array([[3.0, 3.0]]), np.array([99.0]), np.ones(1), np.ones(1)
    )
    here = Evidence(
        np.array([[[400.0, 2.0], [2.0, 3.0]]]), np.array([[2.9, 5.0]]), np.array([90.0]), np.ones(1), np.ones(1)
    )
    found = borne_out(here, first, np.array([1.0, 1.0]), np.array([1.0, 0.5]))
    np.testing.assert_allclose(found.a[0], [[1.0, 0.1], [0.1, 3.0]])
    np.testing.assert_array_equal(found.b, here.b)
    assert borne_out(here, first, np.zeros(2), np.zeros(2)) is here


def test_nothing_fitted_is_left_alone() -> None:
    empty = Evidence(np.zeros((3, 0, 0)), np.zeros((3, 0)), np.ones(3), np.ones(3), np.ones(3))
    assert borne_out(empty, empty, np.zeros(0), np.zeros(0)) is empty


def test_what_is_expected_is_told_anew_and_not_besides() -> None:
    random, column = np.random.default_rng(1), Column("air_drag_normal", "coefficient", ())

    def window(scale: float, residual: np.ndarray) -> Response:
        columns = scale * random.normal(size=(4, 5, 3, 1))
        seen = np.ones(4, bool)
        return Response(0, 1, residual, seen, columns, np.zeros((4, 5, 3, 0)), np.zeros((4, 9)), seen)

    residuals = [random.normal(size=(4, 5, 3)) for _ in range(2)]
    wild, tame = ([window(scale, residual) for residual in residuals] for scale in (1e3, 1.0))
    study = Study.__new__(Study)
    study._expected = None
    study.correct(wild, [column], {column.name: 0.2})
    later = [
        replace(r, residual=r.residual - e) for r, e in zip(tame, study._expected, strict=True)
    ]  # as respond() does
    for found, plain in zip(study.correct(later, [column], {column.name: 0.2}), tame, strict=True):
        np.testing.assert_allclose(found.residual, plain.residual - 0.2 * plain.columns[..., 0], atol=1e-9)
    np.testing.assert_array_equal(study._expected[0], 0.2 * tame[0].columns[..., 0])
