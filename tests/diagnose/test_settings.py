"""An effect that is not linear in a parameter, weighed in all its settings by the roll-outs of one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import measured, simulate

from caphy.diagnose.search import _in_setting, screen
from caphy.effects.model import Model
from caphy.measure.scene import Scene
from caphy.refit.columns import addition, further
from caphy.refit.descent import fit
from caphy.refit.evidence import Weighing
from caphy.refit.laws import told_further
from caphy.refit.settings import best_setting, in_setting, settings
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})


def test_another_setting_is_weighed_as_if_all_had_been_rolled_out_in_it():
    study = Study([Scene.of(measured(*simulate(seconds=1.2), seed=1))])
    first = screen(study, MODEL, MODEL)
    place, share = best_setting(first.weighing.of(first.elsewhere["gust"]), MODEL, "gust")
    assert settings("gust")[place] != {"frequency": 1.0}
    assert 0 < share < 1
    found = _in_setting(study, first, "gust", place, MODEL, None)
    alone = screen(study, in_setting(MODEL, "gust", place), MODEL, None, first)
    assert found.model.to_json() == alone.model.to_json()
    assert [score.group.label for score in found.scores] == [score.group.label for score in alone.scores]
    for one, other in zip(found.scores, alone.scores, strict=True):
        assert one.gain == pytest.approx(other.gain, abs=1e-9)
        np.testing.assert_allclose(one.change, other.change, rtol=1e-6, atol=1e-12)
    assert found.needed == pytest.approx(alone.needed)
    before = {score.group.label: score.gain for score in first.scores}
    assert [s.group.label for s in found.scores if s.gain != pytest.approx(before[s.group.label])] == ["gust"]
    assert "gust" not in found.elsewhere


def test_what_retelling_the_mesh_moved_is_still_known_once_a_frequency_is_fitted():
    """Else intervals of an effect that stays would shrink because another one was looked at more closely."""
    study = Study([Scene.of(measured(*simulate(seconds=1.2), seed=1))])
    columns, model = addition("mass_damping") + addition("gust"), MODEL.with_effect("gust", frequency=1.2)
    windows = study.respond(model, columns)
    found = fit(study, model, columns, windows, Weighing.robust(windows, study.variance(windows)), rounds=1)
    best = replace(found, by_retelling={columns[0]: 0.25})
    on = told_further(study, best, "gust")
    assert set(on.columns) == {*columns, *further("gust")}
    assert on.by_retelling[columns[0]] == 0.25
