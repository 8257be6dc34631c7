"""Base measurements of before an effect was added to a model do not take it out of the model again."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from explicit_cloth import measured, simulate

from caphy.diagnose import base
from caphy.diagnose.base import base_of
from caphy.diagnose.earlier import earlier
from caphy.diagnose.figures import learned_of
from caphy.effects.model import Model
from caphy.errors import Diverged
from caphy.io.measurements import Measurement
from caphy.measure.scene import Scene
from caphy.refit.study import Study

PLAIN = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
DRAGGED = PLAIN.with_effect("mass_damping", rate=3.0).revised(PLAIN, "refit with mass_damping")
WINDY = DRAGGED.with_effect("wind_normal", coefficient=0.2).revised(DRAGGED, "refit with wind_normal")


def film(drag: float) -> Measurement:
    return measured(*simulate(1.2, settle=2.0, drag=drag))


@pytest.mark.parametrize(("drag", "later"), [(0.0, ("mass_damping",)), (0.6, ())])
def test_films_tell_of_which_model_they_are(drag, later):
    """Of 0.6 kg/m^2/s, a rate of 3 1/s, or of none."""
    found = earlier(Study([Scene.of(film(drag))]), DRAGGED)
    assert (() if found is None else found.later) == later
    if found is not None:
        assert found.model == PLAIN and found.median_mm[0] < found.median_mm[1]


def test_what_was_added_stays_as_it_is_and_is_told(monkeypatch):
    """Whatever base measurements do to the rest."""
    softer = PLAIN.with_effect("strain_stvk", lame_mu=7.0)
    learned = base.Base(softer, (), {}, *[None] * 3, 0.0, 0.3, {"strain_stvk.lame_mu": -0.3}, {}, 0.0, 0.0, 2.0)
    monkeypatch.setattr(base, "from_base", lambda study, model: learned if model == PLAIN else None)
    found = base_of(DRAGGED, [film(0.0)])
    assert found is not None
    assert found.model == DRAGGED.with_effect("strain_stvk", lame_mu=7.0)
    assert found.model.history == DRAGGED.history
    assert "of before mass_damping came into the model" in learned_of(found)[0]
    assert "strain_stvk.lame_mu -30 %" in learned_of(found)[1]


@pytest.mark.parametrize(("best", "later"), [(0, ()), (1, ("wind_normal",)), (2, ("mass_damping", "wind_normal"))])
def test_the_last_revisions_are_tried_one_after_another(best, later):
    """One under which cloth flies apart is none of them."""

    class Films:
        def respond(self, model: Model, columns: tuple, what: str) -> list:
            gone = len(WINDY.effects) - len(model.effects)
            if gone > best:
                raise Diverged("it flies apart")
            return [SimpleNamespace(error=np.full(3, 1e-3 * (3 - gone)))]

    found = earlier(Films(), WINDY)  # pyright: ignore
    assert (() if found is None else found.later) == later


def test_a_model_without_history_is_taken_as_it_is():
    plain = Model(DRAGGED.density, DRAGGED.effects)
    assert earlier(Study([Scene.of(film(0.0))]), plain) is None
