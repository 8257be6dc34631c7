"""Fits to a strong effect, whose tangents tell little of it: as numbers alone, whose truth is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from caphy.effects.model import Model
from caphy.refit.columns import addition
from caphy.refit.descent import fit, retold, weighed_anew
from caphy.refit.evidence import Weighing
from caphy.refit.responses import Response
from caphy.refit.study import Study

MODEL, COLUMNS, TRUE = Model(0.2, {"inertia": {}}), addition("mass_damping"), 3.0
WINDOWS, MODES = 12, 6
NUISANCE = np.full((2, MODES, 3, 1), 1e-9)  # next to none


class Told(Study):
    """Windows of two lags, in which everything moves by ``way`` of a rate of damping as ``slope`` says that it does."""

    noise = 1e-4

    def __init__(self, way: Callable[[float], np.ndarray], slope: Callable[[float], np.ndarray], astray: float) -> None:
        self.way, self.slope, self.mesh = way, slope, None
        random = np.random.default_rng(0)
        self.size = random.uniform(0.5, 2.0, (WINDOWS, 1, MODES, 3))
        self.left = random.normal(0, 1e-3, (WINDOWS, 2, MODES, 3))
        self.left[:, 0] -= astray * self.size[:, 0]

    def respond(self, model, columns, what="", pushes=None, anew=(), free=False):
        rate = float(model.effects.get("mass_damping", {}).get("rate", 0.0))
        away = (self.way(TRUE) - self.way(rate))[:, None, None] * self.size + self.left
        moved = self.slope(rate)[:, None, None] * self.size
        seen, error = np.ones(2, bool), np.zeros((2, 1))
        return [
            Response(0, number, residual, seen, column[..., None], NUISANCE, error, seen)
            for number, (residual, column) in enumerate(zip(away, moved, strict=True))
        ]


class Coarse(Told):
    """The same, where a coarse mesh hides 5/6 of what a rate lacks; what it gets wrong is subtracted as last told."""

    told = 0.0

    def respond(self, model, columns, what="", pushes=None, anew=(), free=False):
        rate = float(model.effects.get("mass_damping", {}).get("rate", 0.0))
        if "solver" in anew:
            self.told = rate
        windows = super().respond(model, columns, what, pushes, anew, free)
        wrong = 5 / 6 * (self.way(TRUE) - self.way(self.told))[:, None, None] * self.size
        return [replace(each, residual=each.residual - error) for each, error in zip(windows, wrong, strict=True)]


class Counted(Told):
    """Counts how often it is asked."""

    asked = 0

    def respond(self, model, columns, what="", pushes=None, anew=(), free=False):
        self.asked += 1
        return super().respond(model, columns, what, pushes, anew, free)


def fitted(study: Told):
    """The fit from nothing, with what variance and weights say there."""
    responses = study.respond(MODEL, COLUMNS)
    variance = study.variance(responses)
    return fit(study, MODEL, COLUMNS, responses, Weighing.robust(responses, variance))


def test_a_fit_does_not_end_on_its_way():
    """Tangents that say five times what roll-outs do: seven steps of theirs would leave a fifth."""
    found = fitted(Told(lambda a: 0.01 * a * np.ones(2), lambda a: 0.05 * np.ones(2), 0.0))
    assert found.converged
    assert found.change[0] == pytest.approx(TRUE, rel=0.05)


def test_a_fit_does_not_go_to_and_fro():
    """Tangents that say half of what roll-outs do: each of their steps goes twice as far as it should."""
    study = Counted(lambda a: 0.01 * a * np.ones(2), lambda a: 0.005 * np.ones(2), 0.0)
    found = fitted(study)
    assert found.change[0] == pytest.approx(TRUE, rel=0.02)
    assert found.converged and study.asked <= 5


def test_errors_are_told_of_each_model_on_the_way():
    """Each telling lets a sixth more of the rate be seen."""
    study = Coarse(lambda a: 0.1 * a * np.ones(2), lambda a: 0.1 * np.ones(2), 0.0)
    before = fitted(study)
    after = retold(study, before)
    assert before.change[0] == pytest.approx(TRUE / 6, rel=0.02)
    assert after.change[0] == pytest.approx(TRUE, rel=0.03)
    assert after.by_retelling[COLUMNS[0]] == pytest.approx(after.change[0] - before.change[0])
    assert study.told == after.change[0]  # of what the fit ended with


def test_variance_and_weights_follow_a_strong_effect():
    """The second lag tells more and more of the rate, which tangents at first do not know, and so looks like noise; the
    first is astray."""
    way = lambda a: 0.01 * np.array([a, a + 0.3 * a**2])  # noqa: E731
    study = Told(way, lambda a: 0.01 * np.array([1, 1 + 0.6 * a]), astray=0.005)
    before = fitted(study)
    after = weighed_anew(study, replace(before, by_retelling={COLUMNS[0]: 0.4}))
    assert after.by_retelling == {COLUMNS[0]: 0.4}  # what was doubted still is
    assert before.change[0] < 0.98 * TRUE
    assert after.change[0] == pytest.approx(TRUE, rel=0.004)
    assert after.converged


def test_weights_of_a_weak_effect_stay():
    study = Told(lambda a: 1e-5 * a * np.ones(2), lambda a: 1e-5 * np.ones(2), 0.0)
    found = fitted(study)
    assert weighed_anew(study, found) is found


class Snapping(Told):
    """One window misses more by far with any damping: its cloth snaps into another fold."""

    def respond(self, model, columns, what="", pushes=None, anew=(), free=False):
        found = super().respond(model, columns, what, pushes, anew, free)
        if "mass_damping" in model.effects and model.effects["mass_damping"]["rate"] > 0:
            found[0] = replace(found[0], residual=found[0].residual + 0.003 * np.sign(self.left[0]))
        return found


def test_a_weak_effect_is_fitted_though_a_window_snaps():
    study = Snapping(lambda a: 4e-5 * a * np.ones(2), lambda a: 4e-5 * np.ones(2), 0.0)
    found = fitted(study)
    assert found.misfit > 1.05 * (found.first.weight * found.first.c).sum()
    assert found.change[0] == pytest.approx(TRUE, rel=0.4)
    assert 0 < found.share < 0.03


def test_what_only_makes_things_worse_is_not():
    """A step that goes three times too far, as slopes at its end say too."""
    way = lambda a: 1.2e-4 * (1 if a == TRUE else 3 * (a > 0)) * np.ones(2)  # noqa: E731
    slope = lambda a: 4e-5 * (3 if a > 0 else 1) * np.ones(2)  # noqa: E731
    assert fitted(Snapping(way, slope, 0.0)).change[0] == 0
