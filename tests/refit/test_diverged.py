"""A fit goes on with shorter steps where the next one would make cloth fly apart."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from explicit_cloth import measured, simulate

from caphy.effects.model import Model
from caphy.errors import CaphyError, Diverged
from caphy.measure.scene import Scene
from caphy.refit.columns import addition
from caphy.refit.descent import fit
from caphy.refit.evidence import Weighing
from caphy.refit.study import Study
from caphy.solve.newton import Newton

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})


class Fragile(Study):
    """Cloth that flies apart beyond a rate of damping [1/s]."""

    most = np.inf

    def respond(self, model, *rest, **more):
        if model.effects.get("mass_damping", {}).get("rate", 0.0) > self.most:
            raise Diverged("flies apart")
        return super().respond(model, *rest, **more)


def test_a_step_too_far_is_made_shorter() -> None:
    study, columns = Fragile([Scene.of(measured(*simulate(drag=0.3), seed=1))]), addition("mass_damping")
    responses = study.respond(MODEL, columns)
    weighing = Weighing(study.variance(responses), np.ones(len(responses)))
    free = fit(study, MODEL, columns, responses, weighing).change[0]
    assert free > 0.5
    study.most = 0.6 * free
    found = fit(study, MODEL, columns, responses, weighing)
    assert 0.2 * free < found.change[0] <= study.most and not found.converged
    study.most = 0.0
    assert fit(study, MODEL, columns, responses, weighing).change[0] == 0


def test_other_mistakes_are_not_hidden() -> None:
    study, columns = Fragile([Scene.of(measured(*simulate(drag=0.3), seed=1))]), addition("mass_damping")
    responses = study.respond(MODEL, columns)
    weighing = Weighing(study.variance(responses), np.ones(len(responses)))
    study.respond = lambda *rest, **more: (_ for _ in ()).throw(CaphyError("a process died"))  # type: ignore[method-assign]
    with pytest.raises(CaphyError, match="died"):
        fit(study, MODEL, columns, responses, weighing)


def test_the_solver_says_that_cloth_flew_apart() -> None:
    scene = Scene.of(measured(*simulate(), seed=1))
    potential = scene.potential(MODEL)
    x = torch.full((len(scene.garment.vertices), 3), torch.nan, dtype=torch.float64)
    with pytest.raises(Diverged):
        Newton(potential, scene.fixed).minimise(x, None)
