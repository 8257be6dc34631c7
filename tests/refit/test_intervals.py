"""Intervals of fitted numbers: they cover as often as they say, and know what base measurements teach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from caphy.effects.model import Model
from caphy.refit.columns import Column
from caphy.refit.evidence import Evidence, Weighing
from caphy.refit.fit import Fit
from caphy.refit.intervals import half_widths, intervals
from caphy.refit.learned import Learned
from caphy.refit.responses import Response

DRAG, PRESSURE = Column("mass_damping", "rate"), Column("pressure", "pressure")
EVEN = Weighing(np.ones((1, 1)), np.ones(15))
MODEL = Model(0.2, {"gravity": {}})


def windows(truth: np.ndarray, random: np.random.Generator, spread: float = 0.0, count: int = 15) -> Evidence:
    """Quadratic forms of windows with 40 entries each of unit noise, the truth (K,) differing a little in each."""
    s = random.normal(size=(count, 40, len(truth)))
    e = np.einsum("wek,wk->we", s, truth + random.normal(scale=spread, size=(count, len(truth))))
    e += random.normal(size=e.shape)
    a, b = np.einsum("wek,wel->wkl", s, s), np.einsum("wek,we->wk", s, e)
    return Evidence(a, b, (e * e).sum(1), np.ones(count), np.full(count, 40))


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_intervals_cover_as_often_as_they_say(spread):
    """Also where windows disagree by more than their noise, which formulas for independent residuals do not see."""
    random, truth, covered = np.random.default_rng(0), np.array([1.0, -2.0]), []
    for _ in range(150):
        known = windows(truth, random, spread)
        best = np.linalg.solve(known.a.sum(0), known.b.sum(0))
        covered.append(np.abs(best - truth) < half_widths(known, 0.0)[0])
    assert 0.91 < np.mean(covered) < 0.99


@pytest.mark.parametrize("count", [4, 15])
def test_windows_alike_are_sure_of_their_mean_as_student_is(count):
    """A number of which each window tells one noisy value: the exact interval of a normal mean (Student 1908)."""
    random, ratios = np.random.default_rng(3), []
    for seed in range(40):
        told = random.normal(size=count)
        known = Evidence(np.ones((count, 1, 1)), told[:, None], told**2, np.ones(count), np.full(count, 40))
        exact = student.ppf(0.975, count - 1) * told.std(ddof=1) / np.sqrt(count)
        ratios.append(half_widths(known, 0.0, seed=seed)[0][0] / exact)
    assert 0.98 < np.mean(ratios) < 1.02


def test_where_few_windows_decide_the_others_do_not_tell_how_far_off_they_are():
    """Three windows of fifteen; a resample without them would give anything."""
    random, truth, covered, widths = np.random.default_rng(1), np.array([1.0]), [], []
    for _ in range(150):
        known = windows(truth, random, 0.2)
        faint = (np.arange(15) >= 3) * random.uniform(1e-3, 1e-2, 15)
        scale = np.where(faint > 0, faint, 1.0)
        # What is left where the number does nothing has no size of its own there.
        known = replace(known, a=known.a * scale[:, None, None] ** 2, b=known.b * scale[:, None])
        best = known.b.sum(0) / known.a.sum(0)[0]
        widths.append(half_widths(known, 0.0)[0])
        covered.append(np.abs(best - truth) < widths[-1])
    assert np.mean(covered) > 0.91
    assert np.median(widths) < 1.5  # Student's t of two degrees on 0.14, three windows: 0.73 with its widening


def learned(numbers: list[float], ridge: float = 1e-12) -> Learned:
    """Base motions of three windows, each of which asks for a number of the first column and none of the second."""
    count = 3 * len(numbers)
    a = np.tile(np.diag([4.0, 9.0]), (count, 1, 1))
    b = np.column_stack([4.0 * np.repeat(numbers, 3), np.zeros(count)])
    told = Evidence(a, b, np.full(count, 100.0), np.ones(count), np.full(count, 40))
    correction = {DRAG.name: float(np.mean(numbers)), PRESSURE.name: 0.0}
    motions = np.repeat(np.arange(len(numbers)), 3)
    return Learned(MODEL, (DRAG, PRESSURE), correction, np.ones((1, 1)), told, motions, ridge, 0.0)


def test_doubt_is_what_the_other_base_motions_leave():
    """Two motions that ask for 1 and 3: each is left with 2 by the other, and 2 is what is taken off."""
    found = learned([1.0, 3.0]).doubt((DRAG, PRESSURE), 4)
    np.testing.assert_allclose(found, [np.hypot(2 / np.sqrt(4), 2.0), 0.0], rtol=1e-5)
    assert learned([0.3, 0.3]).doubt((DRAG,), 1) == pytest.approx([0.3])


def test_with_one_base_motion_all_that_it_asks_for_is_in_doubt():
    np.testing.assert_allclose(learned([0.7]).doubt((DRAG,), 1), [np.hypot(0.7, 0.7)], rtol=1e-6)


def test_a_number_that_base_measurements_do_not_know_is_not_doubted():
    other = Column("added_mass", "density")
    np.testing.assert_allclose(learned([1.0, 3.0]).doubt((other, PRESSURE), 1), [0.0, 0.0], atol=1e-9)


def test_a_law_is_doubted_as_far_as_the_effect_that_it_refines_leads_it_astray():
    wind = Column("wind_normal_quadratic", "velocity", (0,))
    known = learned([1.0, 3.0])
    (alone,), both = known.doubt((DRAG,), 4), known.doubt((wind, PRESSURE), 4, {wind: {DRAG: -0.5, PRESSURE: 7.0}})
    np.testing.assert_allclose(both, [0.5 * alone, 0.0], rtol=1e-5)


def moved_more(by: float) -> list[Response]:
    """Windows in which the first number has so many times the curvature of :func:`learned`'s, the second as much."""
    columns = np.zeros((13, 1, 3, 2))
    columns[0, 0, 0, 0], columns[1, 0, 0, 1] = np.sqrt(4.0 * by), 3.0
    rest = np.zeros((13, 1, 3))
    seen = np.ones(13, bool)
    return [Response(0, 0, rest, seen, columns, np.zeros((13, 1, 3, 0)), rest[..., 0], seen)] * 5


def test_what_the_base_hardly_moved_is_not_expected_where_it_moves():
    """A number's correction holds up to ten times the base's curvature, and falls with what is beyond."""
    known = replace(learned([1.0, 3.0]), variance=np.ones((13, 1)))
    known = replace(known, correction={DRAG.name: 2.0, PRESSURE.name: 0.5})
    for by, expected in ((1.0, 2.0), (9.9, 2.0), (1e4, 2.0 * 10 / 1e4)):
        told = known.correction_in(moved_more(by), (DRAG, PRESSURE))
        assert told == pytest.approx({DRAG.name: expected, PRESSURE.name: 0.5})
    assert known.correction_in(moved_more(1.0), (PRESSURE,)) == pytest.approx({PRESSURE.name: 0.5})


def test_doubts_keep_their_size_beside_what_windows_tell():
    known = learned([1.0, 3.0])
    plain = known.doubt((DRAG, PRESSURE), 4)
    for by, share in ((5.0, 1.0), (1e3, np.sqrt(10 / 1e3))):
        here = replace(known.told, a=known.told.a * by)
        np.testing.assert_allclose(known.doubt((DRAG, PRESSURE), 4, known=here), share * plain)
    wind = Column("wind_normal_quadratic", "velocity", (0,))
    followed = known.doubt((wind,), 4, {wind: {DRAG: 1.0}}, replace(known.told, a=known.told.a[:, :1, :1] * 1e3))
    np.testing.assert_allclose(followed, plain[:1], rtol=1e-5)


def test_doubt_adds_to_what_resampling_shows():
    known = windows(np.array([1.0, -2.0]), np.random.default_rng(1))
    alone = half_widths(known, 0.0)[0]
    np.testing.assert_allclose(
        half_widths(known, np.array([0.0, 3.0]))[0], np.hypot(alone, [0.0, 1.959964 * 3.0]), rtol=1e-6
    )


def test_a_fit_that_ended_early_says_how_far_it_still_was():
    """Windows that ask for one unit more than the model has: a standard error beside their own, upwards."""
    known, fitted = windows(np.array([1.0]), np.random.default_rng(2)), MODEL.with_effect("mass_damping", rate=2.0)
    fit = Fit(MODEL, fitted, (DRAG,), known, [], known, 1.0, np.ones(15), EVEN)
    (left,) = np.linalg.solve(known.a.sum(0), known.b.sum(0))
    value, low, high, unit = intervals(fit, None, 3)["mass_damping.rate"]
    assert (value, unit) == (2.0, "1/s")
    wanted = np.hypot(half_widths(known, 0.0)[0], 1.959964 * left)[0]
    np.testing.assert_allclose([value - low, high - value], [half_widths(known, 0.0)[0][0], wanted], rtol=1e-5)


def test_an_interval_ends_where_the_parameter_does():
    """A rate of damping near zero is not negative."""
    known, fitted = windows(np.array([0.0]), np.random.default_rng(2)), MODEL.with_effect("mass_damping", rate=1e-3)
    fit = Fit(MODEL, fitted, (DRAG,), known, [], known, 1.0, np.ones(15), EVEN)
    _, low, high, _ = intervals(fit, None, 3)["mass_damping.rate"]
    assert half_widths(known, 0.0)[0][0] > 1e-3
    assert low == 0.0 and high > 1e-3


def test_what_retelling_the_mesh_moved_is_in_doubt():
    """A number that went half a unit because of it may be half a unit off, on either side, beside all else."""
    known, fitted = windows(np.array([0.0]), np.random.default_rng(2)), MODEL.with_effect("mass_damping", rate=2.0)
    fit = Fit(MODEL, fitted, (DRAG,), known, [], known, 1.0, np.ones(15), EVEN)
    told = replace(fit, by_retelling={DRAG: 0.5, PRESSURE: 9.0})
    (_, low, high, _), (_, lower, higher, _) = (intervals(one, None, 3)["mass_damping.rate"] for one in (fit, told))
    assert 2.0 - lower == pytest.approx(np.hypot(2.0 - low, 0.5), rel=1e-6)
    assert higher - 2.0 == pytest.approx(np.hypot(high - 2.0, 0.5), rel=1e-6)


def test_of_a_relative_number_too():
    """A stiffness that is told as threefold, by retelling the mesh a half of the first more: so much on either side."""
    stiffness = Column("strain_stvk", "lame_mu", None)
    model, known = Model(0.2, {"strain_stvk": {"lame_mu": 10.0}}), windows(np.array([0.0]), np.random.default_rng(2))
    sharp = replace(known, a=1e6 * known.a, b=0 * known.b)
    fit = Fit(
        model, Model(0.2, {"strain_stvk": {"lame_mu": 30.0}}), (stiffness,), sharp, [], sharp, 1.0, np.ones(15), EVEN
    )
    value, low, high, _ = intervals(replace(fit, by_retelling={stiffness: 0.5}), None, 3)["strain_stvk.lame_mu"]
    assert value == pytest.approx(2.0)
    assert (value - low, high - value) == pytest.approx((0.5, 0.5), rel=1e-2)


def test_a_fit_has_settled_by_what_its_change_takes_away_where_it_ended():
    """A stiffness six times as large: of the curvature there the whole change is 5/6, not 5."""
    stiffness = Column("strain_stvk", "lame_mu", None)
    first, there = (Model(0.2, {"strain_stvk": {"lame_mu": mu}}) for mu in (10.0, 60.0))
    one = np.ones((5, 1, 1))
    before = Evidence(one, np.ones((5, 1)), np.full(5, 1e3), np.ones(5), np.full(5, 40))
    after = replace(before, b=np.full((5, 1), 0.05))
    fit = Fit(first, there, (stiffness,), before, [], after, 1.0, np.ones(5), EVEN)
    assert fit.promise == pytest.approx(5 * 0.05**2)
    assert not fit.settled
