"""Fits judged one after another on the same held-out windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import measured, simulate

from caphy.effects.model import Model
from caphy.measure.scene import Scene
from caphy.refit.columns import addition, extended, moved
from caphy.refit.descent import fit, tried
from caphy.refit.evidence import Weighing, evidence
from caphy.refit.fit import judged
from caphy.refit.heldout import Apart
from caphy.refit.learned import Learned
from caphy.refit.responses import Response, median_mm
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
KNOWN = {"mass_damping.rate": 0.4, "air_drag_normal.coefficient": 0.0}


def test_a_fit_is_judged_alike_whatever_was_judged_before() -> None:
    study = Study([Scene.of(measured(*simulate(seconds=1.2), seed=1))])
    columns = (*addition("mass_damping"), *addition("air_drag_normal"))
    responses = study.respond(MODEL, columns)
    variance, weight = study.variance(responses), np.ones(len(responses))
    found = fit(study, MODEL, columns, responses, Weighing(variance, weight), rounds=1)
    other = replace(found, origin=MODEL.with_effect("mass_damping", rate=0.2))  # judged from elsewhere
    told = evidence(responses, variance)
    learned = Learned(MODEL, columns, KNOWN, variance, told, np.zeros(len(responses)), 1.0, 0.0)
    apart = Apart(Study(study.scenes), variance, columns, learned)
    by_itself = {each: Apart(Study(study.scenes), variance, columns, learned).errors(each) for each in (found, other)}
    for each in (found, other, found):
        alone, together = by_itself[each], apart.errors(each)
        np.testing.assert_allclose(together.before, alone.before, rtol=1e-9)
        np.testing.assert_allclose(together.after, alone.after, rtol=1e-9)
        np.testing.assert_allclose([together.share, together.share_error], [alone.share, alone.share_error], rtol=1e-6)


class Coarse(Study):
    """Windows in which a rate moves cloth by half of what it should: the rest is the mesh's error, which is told of
    some rate. Nothing else is in them but a little noise."""

    RATE = 2.0

    def __init__(self, told: float = 0.0) -> None:
        self.scenes, self.told = (), told
        random = np.random.default_rng(0)
        self.size, self.noise_in = random.normal(0, 1e-3, (12, 4, 6, 3)), random.normal(0, 3e-3, (12, 4, 6, 3))

    def afresh(self) -> Study:
        return Coarse()

    def likewise(self) -> Study:
        return Coarse(self.told)

    def correct(self, responses, columns, known):
        return list(responses)

    def respond(self, model, columns, what="", pushes=None, anew=(), free=False):
        rate = float(model.effects.get("mass_damping", {}).get("rate", 0.0))
        if "solver" in anew:
            self.told = rate
        left = self.noise_in + self.size * (self.RATE - 0.5 * rate - 0.5 * self.told)
        seen, nothing = np.ones(4, bool), np.full((4, 6, 3, 1), 1e-9)
        return [
            Response(0, start, each, seen, 0.5 * size[..., None], nothing, np.ones((4, 1)), seen)
            for start, (each, size) in enumerate(zip(left, self.size, strict=True))
        ]

    @property
    def floor_mm(self):
        return None


def test_what_the_mesh_keeps_an_effect_from_doing_counts() -> None:
    """Slopes alone tell half of the way, three quarters of what it takes away."""
    study, columns, variance = Coarse(), addition("mass_damping"), np.full((4, 6), 9e-6)
    model = moved(extended(MODEL, columns), columns, np.array([Coarse.RATE]))
    responses = study.respond(MODEL, columns)
    weighing = Weighing.robust(responses, variance)
    found = judged(MODEL, MODEL, columns, responses, weighing)
    found = tried(study, found, model, "there")
    assert found is not None
    apart = Apart(study, variance)
    told = [apart.errors(found).share for _ in range(2)]
    ends = Coarse(0.0).respond(MODEL, columns), Coarse(Coarse.RATE).respond(model, columns)
    old, new = (float((weighing.weight * weighing.of(each).c).sum()) for each in ends)
    assert told[0] == told[1]  # what was told of the fit the first time is not known the second
    np.testing.assert_allclose(told[0], 1 - new / old, rtol=0.02)


def test_two_models_are_compared_alike_whatever_was_judged_before() -> None:
    """Errors of the mesh are told of each of them, not of what a fit began with."""
    columns, variance = addition("mass_damping"), np.full((4, 6), 9e-6)
    model = moved(extended(MODEL, columns), columns, np.array([Coarse.RATE]))
    responses = Coarse().respond(MODEL, columns)
    found = judged(MODEL, MODEL, columns, responses, Weighing(variance, np.ones(len(responses))))
    apart, alone = Apart(Coarse(), variance), Apart(Coarse(), variance)
    apart.errors(found)
    ends = apart.between(MODEL, model).share, alone.between(MODEL, model).share
    assert ends[0] == ends[1]
    whole = [(each.residual**2).sum() for each in Coarse(Coarse.RATE).respond(model, columns)]
    before = [(each.residual**2).sum() for each in responses]
    np.testing.assert_allclose(ends[0], 1 - sum(whole) / sum(before), rtol=0.05)


def test_a_model_alone_has_one_error() -> None:
    """As where nothing was added to it."""
    study = Study([Scene.of(measured(*simulate(seconds=1.2), seed=1))])
    apart = Apart(study, np.ones((1, 1)))
    alone, again = apart.of(MODEL), median_mm(Study(study.scenes).respond(MODEL, ()))
    assert alone.before_mm == alone.after_mm == pytest.approx(again) and alone.share == alone.share_error == 0.0
