"""Fits judged one after another on the same held-out windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from explicit_cloth import measured, simulate

from caphy.effects.model import Model
from caphy.measure.scene import Scene
from caphy.refit.columns import addition
from caphy.refit.descent import fit
from caphy.refit.evidence import evidence
from caphy.refit.heldout import Apart
from caphy.refit.learned import Learned
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
KNOWN = {"mass_damping.rate": 0.4, "air_drag_normal.coefficient": 0.0}


def test_a_fit_is_judged_alike_whatever_was_judged_before() -> None:
    study = Study([Scene.of(measured(*simulate(seconds=1.2), seed=1))])
    columns = (*addition("mass_damping"), *addition("air_drag_normal"))
    responses = study.respond(MODEL, columns)
    variance, weight = study.variance(responses), np.ones(len(responses))
    found = fit(study, MODEL, columns, responses, variance, weight, rounds=1)
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
