"""What acts in few windows: how many decide, and what chance gives it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.diagnose.screen import borrowed_gains, gains, in_few, null_gains
from caphy.refit.borrowed import deciding, where_few_decide
from caphy.refit.evidence import Evidence, evidence
from caphy.refit.fit import share_gone
from caphy.refit.heldout import HeldOut
from caphy.refit.responses import Response

LAGS, MODES, WINDOWS = 8, 10, 12
VARIANCE = np.full((LAGS, MODES), 1e-6)
LIMITS = np.array([-np.inf, 0.0]), np.array([np.inf, np.inf])


def windows(planted: float, seed: int) -> list[Response]:
    """Column 0 acts everywhere, column 1 in two windows only, where it is there by so much."""
    random = np.random.default_rng(seed)
    found = []
    for number in range(WINDOWS):
        shape = (LAGS, MODES, 3)
        # Errors of a mesh: smooth in time, a few modes, another amount in each window.
        left = np.linspace(0, 1, LAGS)[:, None, None] * random.normal(0, 3e-3, (MODES, 3)) * random.uniform(0.5, 2)
        everywhere = random.normal(0, 1e-3, shape)
        there = random.normal(0, 1e-3, shape) * np.linspace(0, 1, LAGS)[:, None, None] * (number in (4, 9))
        residual = left + random.normal(0, 1e-3, shape) + planted * there
        seen = np.ones(LAGS, bool)
        seen[number % LAGS] = number % 3 > 0  # a frame is missing in some
        nuisance = random.normal(0, 1e-3, (*shape, 4))
        columns = np.stack([everywhere, there], -1)
        found.append(Response(0, number, residual, seen, columns, nuisance, np.zeros(LAGS), np.ones(LAGS, bool)))
    return found


def gain(known: Evidence) -> float:
    picked = known.picked([1])
    return float(gains(picked, picked.b[None], np.zeros(1), np.full(1, np.inf))[0])


def test_equal_windows_all_decide_and_one_that_outweighs_the_others_decides_alone():
    share = np.ones(9)
    assert deciding(share) == pytest.approx(9)
    share[0] = 1e4
    assert deciding(share) == pytest.approx(1, abs=0.01)
    assert deciding(np.zeros(9)) == 0


def test_one_window_alone_has_no_elsewhere():
    """Nor where the number that was fitted is zero, so that none decides."""
    (one,) = windows(0.0, 0)[:1]
    assert where_few_decide(evidence([one], VARIANCE), [one], VARIANCE, np.zeros(2)) is None


def test_where_all_windows_are_few_there_is_no_elsewhere():
    places = {"everywhere": [0], "there": [1]}
    known = evidence(windows(0.0, 0), VARIANCE)
    assert in_few(known, places) == ["there"]
    three = evidence(windows(0.0, 0)[3:6], VARIANCE)
    assert in_few(three, {"everywhere": [0]}) == []


def test_what_is_there_is_beyond_other_windows_residuals_though_signs_give_the_same():
    found = windows(2.0, 1)
    known = evidence(found, VARIANCE)
    assert np.quantile(null_gains(known, [[1]], LIMITS), 0.95) == pytest.approx(gain(known))
    assert gain(known) > 1.5 * borrowed_gains(known, found, VARIANCE, [[1]], LIMITS).max()


def test_what_is_not_there_is_beyond_them_as_seldom_as_was_asked_for():
    beyond = 0
    for seed in range(60):
        found = windows(0.0, seed)
        known = evidence(found, VARIANCE)
        beyond += gain(known) > np.quantile(borrowed_gains(known, found, VARIANCE, [[1]], LIMITS), 0.95)
    assert beyond <= 8  # 3 expected; binomial: more than 8 once in 200 times


@pytest.mark.parametrize(("planted", "proven"), [(1.0, True), (0.0, False), (-1.0, False)])
def test_held_out_windows_prove_what_few_of_them_show(planted, proven):
    """Two of twelve windows: a standard error over windows is near the sum itself."""
    found, change = windows(planted, 3), np.array([0.0, 1.0])
    known = evidence(found, VARIANCE)
    share, error = share_gone(known, replace(known, b=known.b - known.a @ change), change)
    few = where_few_decide(known, found, VARIANCE, change)
    assert few is not None
    held = HeldOut(2.0, 1.99, None, np.ones(12), np.ones(12), share, error)
    assert not held.proves(0.1)
    assert replace(held, few=few).proves(share) == proven
    if planted:
        assert abs(share) == pytest.approx(few.promise if proven else 3 * few.promise, rel=0.5)


def test_where_many_windows_decide_chance_is_the_standard_error():
    found = windows(0.0, 3)
    assert where_few_decide(evidence(found, VARIANCE), found, VARIANCE, np.array([1.0, 0.0])) is None
