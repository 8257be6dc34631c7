"""Numbers of effects on cloth that snaps: what the fit's own tangents take for an answer is not."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.effects.model import Model
from caphy.refit import fit
from caphy.refit.columns import addition
from caphy.refit.descent import refined
from caphy.refit.evidence import Weighing
from caphy.refit.fit import LARGE, Fit, judged
from caphy.refit.responses import Response
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
COLUMNS = addition("mass_damping")
TRUTH, NOISE, SHAPE = 1.0, 1.5e-3, (8, 10, 3)
VARIANCE = np.full(SHAPE[:2], NOISE**2)
EVEN = Weighing(VARIANCE, np.ones(18))


class Snapping(Study):
    """Windows in which a rate moves cloth in proportion, and in every third of which cloth ripples in it besides:
    small moves, but steep ones. The measurement has its own ripples."""

    def __init__(self, ripple: float, saturates: float = 0.0) -> None:
        self.scenes, self.ripple, self.saturates = (), ripple, saturates
        random, many = np.random.default_rng(5), 18
        self.size, self.noise_in = random.normal(0, 1e-3, (many, *SHAPE)), random.normal(0, NOISE, (many, *SHAPE))
        self.phase, self.wave = random.uniform(0, 2 * np.pi, (many, *SHAPE)), random.uniform(40, 60, (many, *SHAPE))
        self.snaps = np.arange(many) % 3 == 0

    def moved(self, rate: float) -> tuple[np.ndarray, np.ndarray]:
        """By a rate, and its derivative."""
        smooth = np.log1p(self.saturates * rate) / self.saturates if self.saturates else rate
        steep = 1 / (1 + self.saturates * rate)
        here = self.snaps[:, None, None, None] * self.ripple * min(rate, 1.0)  # none where the effect is not there
        angle = self.wave * rate + self.phase
        return smooth * self.size + here * np.sin(angle), steep * self.size + here * self.wave * np.cos(angle)

    def respond(self, model, columns, what="", pushes=None, anew=(), free=False):
        rate = float(model.effects.get("mass_damping", {}).get("rate", 0.0))
        position, slope = self.moved(rate)
        left, nothing, seen = (
            self.moved(TRUTH)[0] + self.noise_in - position,
            np.full((*SHAPE, 1), 1e-9),
            np.ones(SHAPE[0], bool),
        )
        return [
            Response(0, start, each, seen, s[..., None], nothing, np.ones((SHAPE[0], 1)), seen)
            for start, (each, s) in enumerate(zip(left, slope, strict=True))
        ]


def fitted(study: Study, by_own_tangents: bool = False) -> Fit:
    first = study.respond(MODEL, COLUMNS)
    windows = () if by_own_tangents else first
    start = judged(MODEL, MODEL, COLUMNS, first, EVEN, windows=windows)
    return refined(study, start)


def rate(found: Fit) -> float:
    return float(found.model.effects["mass_damping"]["rate"])


@pytest.mark.parametrize("ripple", [5e-5, 1e-4, 1.5e-4, 2e-4, 3e-4])
def test_what_snaps_makes_numbers_small_and_tangents_of_the_origin_do_not(ripple):
    """By 4 to 13 %; what is told where nothing snaps is told again, as near as noise lets it."""
    plain = rate(fitted(Snapping(0.0, saturates=2.0)))
    biased, found = (fitted(Snapping(ripple, saturates=2.0), own) for own in (True, False))
    assert 0 < biased.share < LARGE
    assert rate(biased) < 0.97 * plain
    assert abs(rate(found) - plain) < min(0.03 * plain, (plain - rate(biased)) / 2)


@pytest.mark.parametrize("saturates", [0.0, 1.0])
def test_where_nothing_snaps_both_agree(saturates, monkeypatch):
    """An effect's first bit says nothing of how much the last one does: steps are told by what it does by now."""
    biased = fitted(Snapping(0.0, saturates))
    assert biased.by_instruments is None
    monkeypatch.setattr(fit, "_IN_COMMON", np.inf)  # instruments in any case
    found = fitted(Snapping(0.0, saturates))
    assert found.converged and found.by_instruments is not None
    assert rate(found) == pytest.approx(rate(biased), rel=0.02)


def test_what_was_seen_to_snap_is_not_asked_again():
    study = Snapping(0.0)
    start = judged(MODEL, MODEL, COLUMNS, study.respond(MODEL, COLUMNS), EVEN)
    there = MODEL.with_effect("mass_damping", rate=0.5)
    given = MODEL, there, COLUMNS, study.respond(there, COLUMNS), EVEN, start.most, start.first
    windows = study.respond(MODEL, COLUMNS)
    assert judged(*given, windows).by_instruments is None
    assert judged(*given, windows, snaps=True).by_instruments is not None


class Torn(Snapping):
    """Cloth in one window asks for the opposite, and lies elsewhere altogether once the effect is there."""

    def moved(self, rate: float) -> tuple[np.ndarray, np.ndarray]:
        position, slope = super().moved(rate)
        position[0] += 4 * self.size[0] * (rate == TRUTH) + 0.1 * (rate not in (0.0, TRUTH))
        position[0] -= 8 * self.size[0] * (rate == TRUTH)
        return position, slope


def test_what_is_taken_away_so_far_is_told_by_windows_as_they_count_now():
    """Where moves are in proportion to the number it does at the fit what its first bit did."""
    study = Torn(0.0)
    windows = study.respond(MODEL, COLUMNS)
    start = judged(MODEL, MODEL, COLUMNS, windows, EVEN)
    there = MODEL.with_effect("mass_damping", rate=0.5)
    given = MODEL, there, COLUMNS, study.respond(there, COLUMNS), EVEN, start.most, start.first
    found = judged(*given, windows, snaps=True)
    assert found.evidence.weight[0] < 0.1
    assert found.by_instruments is not None
    assert found.by_instruments.a[1:] == pytest.approx(start.first.a[1:], rel=0.02)


class Folding(Snapping):
    """Cloth in the windows that snap lies in another fold wherever the effect is."""

    def moved(self, rate: float) -> tuple[np.ndarray, np.ndarray]:
        position, slope = super().moved(rate)
        fold = np.random.default_rng(7).normal(0, 1.3 * NOISE, position.shape)
        return position + self.snaps[:, None, None, None] * fold * (rate not in (0.0, TRUTH)), slope


def test_a_fold_that_snaps_stops_no_fit_while_less_is_asked_for():
    """The misfit of roll-outs rises by more than folds usually do, and the effect is found all the same."""
    study = Folding(2e-4)
    biased, found = (fitted(study, own) for own in (True, False))
    assert "mass_damping" not in biased.model.effects
    assert rate(found) == pytest.approx(TRUTH, rel=0.15)
    assert found.misfit > 1.05 * float((found.first.weight * found.first.c).sum())


def test_what_takes_much_away_is_fitted_by_its_own_tangents():
    study = Snapping(0.0)
    study.noise_in = 0.1 * study.noise_in
    found = fitted(study)
    assert found.share > LARGE
    assert found.asked is found.evidence
