"""What a change takes away of the misfit, told by slopes at either end, and when a fit has settled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.effects.model import Model
from caphy.refit.columns import Column, from_the_end
from caphy.refit.evidence import Evidence, Weighing
from caphy.refit.fit import Fit, share_gone

COUNT = 12


def bent(change: float, fall: float, curve: float = 0.5) -> tuple[Evidence, Evidence, float]:
    """Windows at 0 and at ``change`` of a number of which more and more does less and less, and what they really lose.

    The number is right at ``change``, where ``fall`` of the misfit at 0 is gone; there one more does 1 - ``curve`` of
    what it does at 0.
    """
    random = np.random.default_rng(0)
    noise, way = random.normal(size=(COUNT, 400)), random.normal(size=(COUNT, 400))
    way *= np.linalg.norm(noise) / np.linalg.norm(way) * np.sqrt(fall / (1 - fall)) / (change * (1 - curve / 2))

    def at(a: float) -> tuple[Evidence, float]:
        left = change * (1 - curve / 2) - a * (1 - curve * a / change / 2)
        e, s = noise + way * left, way * (1 - curve * a / change)
        forms = [np.einsum("we,we->w", x, y) for x, y in ((s, s), (s, e), (e, e))]
        known = Evidence(forms[0][:, None, None], forms[1][:, None], forms[2], np.ones(COUNT), np.full(COUNT, 400))
        return known, float((e * e).sum())

    (before, old), (after, new) = at(0.0), at(change)
    return before, after, 1 - new / old


@pytest.mark.parametrize("curve", [0.0, 0.4, 0.8, -0.3])
def test_a_bent_path_is_followed(curve):
    before, after, true = bent(3.0, 0.06, curve)
    assert share_gone(before, after, np.array([3.0]))[0] == pytest.approx(true, rel=1e-9)


def test_relative_numbers_are_counted_by_what_they_are_at_either_end():
    before, after, true = bent(2.0, 0.2)
    change = np.array([2.0])
    thrice = replace(after, a=9 * after.a, b=3 * after.b)  # one more of it is thrice as much there
    last = from_the_end([Column("strain_stvk", "lame_mu", None)], change)
    assert share_gone(before, thrice, change, last)[0] == pytest.approx(true, rel=1e-9)
    assert from_the_end([Column("pressure", "pressure")], change) == change


def test_a_fold_that_snaps_says_nothing():
    """It changes a misfit, and no slope."""
    before, after, true = bent(0.5, 0.1)
    snapped = replace(after, c=after.c * 1.04)
    assert share_gone(before, snapped, np.array([0.5]))[0] == pytest.approx(true, rel=1e-9)


def test_where_most_is_gone_rollouts_tell():
    before, after, true = bent(2.0, 0.6)
    share, error = share_gone(before, after, np.array([2.0]))
    assert share == pytest.approx(true, rel=1e-12) and 0 < error < 0.1


def test_where_the_ends_are_at_odds_rollouts_tell_within_what_they_promise():
    before, after, true = bent(1.0, 0.28, 0.5)
    whole, one = before.c.sum(), np.ones(1)
    ahead = -sum(x.sum() for x in (before.along(one)[0], before.along(one)[1] / 2)) / whole
    back = -(after.along(one)[0] - after.along(one)[1] / 2).sum() / whole
    assert ahead - back > 0.1
    assert share_gone(before, after, one)[0] == pytest.approx(true, rel=1e-9)
    snapped = replace(after, c=after.c * 1.3)
    assert share_gone(before, snapped, one)[0] == pytest.approx(back, rel=1e-9)
    snapped = replace(after, c=after.c * 0.98)
    assert share_gone(before, snapped, one)[0] == pytest.approx(true, rel=1e-9)


def test_settled_when_the_step_left_is_small_beside_the_change():
    """Not beside the misfit: an effect of one per cent of it has its number to be found too."""
    drag = Column("mass_damping", "rate")
    start = Model(0.2, {"gravity": {}, "mass_damping": {"rate": 0.0}})

    def at(rate: float) -> Fit:
        """Windows that want a rate of 1 and lose 1 % of their misfit by it."""
        left = np.full(COUNT, 1.0 - rate)
        known = Evidence(np.ones((COUNT, 1, 1)), left[:, None], 99.0 + left**2, np.ones(COUNT), np.full(COUNT, 400))
        model = start.with_effect("mass_damping", rate=rate)
        weighing = Weighing(np.ones((1, 1)), known.weight)
        return Fit(start, model, (drag,), known, [], known, (99.0 + left**2).sum(), known.c, weighing)

    assert [at(rate).settled for rate in (0.5, 0.9, 0.97, 1.0)] == [False, False, True, True]


@pytest.mark.parametrize("strength", [2.0, 3.0, 4.0, 5.0])
def test_what_soon_does_no_more_takes_away_what_it_takes_away(strength):
    """Viscosity: where it begins it promises harm by the whole of the change, and where it ends nothing."""
    random = np.random.default_rng(3)
    noise, way = random.normal(size=(COUNT, 400)), random.normal(size=(COUNT, 400))
    way *= 0.3 * np.linalg.norm(noise) / np.linalg.norm(way)

    def at(a: float) -> Evidence:
        s = way * np.exp(-a)
        e = noise + way * (1 - np.exp(-strength)) - way * (1 - np.exp(-a))
        forms = [np.einsum("we,we->w", x, y) for x, y in ((s, s), (s, e), (e, e))]
        return Evidence(forms[0][:, None, None], forms[1][:, None], forms[2], np.ones(COUNT), np.full(COUNT, 400))

    before, after = at(0.0), at(strength)
    true = 1 - after.c.sum() / before.c.sum()
    assert share_gone(before, after, np.array([strength]))[0] == pytest.approx(true, rel=0.02)
