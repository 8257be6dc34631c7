"""Numbers fitted to clouds that the fitted model registers, until both agree."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from explicit_cloth import clouds, measured, seen, simulate

from caphy.commands.before_after import before_and_after
from caphy.commands.refit import table
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.measure.scene import Scene
from caphy.measure.track import registered
from caphy.refit import again
from caphy.refit.again import Again, agreed, as_registered_first, fitted_again
from caphy.refit.columns import addition, tunable
from caphy.refit.crew import Crew
from caphy.refit.descent import fit
from caphy.refit.evidence import Evidence, Weighing
from caphy.refit.fit import Fit
from caphy.refit.refit import refit
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
COLUMNS = addition("shear_stiffness")
NAME, PARAMETER = COLUMNS[0].effect, COLUMNS[0].parameter


def test_answers_of_a_straight_law_lead_to_where_they_agree():
    metric = np.diag([1.0, 4.0])
    told = lambda at: np.array([3.0, -2.0]) + 0.6 * at  # noqa: E731
    at = [np.zeros(2), told(np.zeros(2)), np.array([9.0, 1.0])]
    for count in (2, 3):
        pairs = [(each, told(each)) for each in at[:count]]
        np.testing.assert_allclose(agreed(pairs, metric), np.array([3.0, -2.0]) / 0.4, rtol=1e-12)
    flat = [(at[0], at[1]), (at[1], at[1])]
    np.testing.assert_allclose(agreed(flat, metric), at[1])  # agreed already


def test_a_law_that_meets_nothing_leads_no_farther_than_believed():
    pairs = [(np.zeros(1), np.ones(1)), (np.ones(1), np.full(1, 2.0))]
    assert agreed(pairs, np.eye(1)) == pytest.approx([1.5 + 4 * 1.0])


class Law:
    """A study whose clouds tell a number by the law ``told`` of that which they were registered with."""

    def __init__(self, told, at: float = 0.0, seen=None) -> None:
        self.told, self.at, self.seen = told, at, [] if seen is None else seen

    def registered_by(self, model: Model) -> Law:
        at = float(np.asarray(model.effects[NAME][PARAMETER]))
        self.seen.append(at)
        return Law(self.told, at, seen=self.seen)


def fitted(value: float) -> Fit:
    model = MODEL.with_effect(NAME, **{PARAMETER: value})
    known = Evidence(np.ones((8, 1, 1)), np.ones((8, 1)), np.ones(8), np.ones(8), np.ones(8))
    return Fit(MODEL, model, COLUMNS, known, [], known, 1.0, np.ones(8), Weighing(np.ones((1, 1)), np.ones(8)))


@pytest.fixture
def plays(monkeypatch):
    """Fits give what the law says."""
    monkeypatch.setattr(
        again, "_fitted", lambda study, best, there, variance: again.Again(study, fitted(study.told(study.at)), [])
    )


@pytest.mark.usefixtures("plays")
def test_registered_until_both_agree():
    clouds = Law(lambda at: 19 + 0.7 * at - 0.0035 * at**2)  # as of a shear stiffness of 45, which it tells as 43
    found = fitted_again(clouds, fitted(19.0), np.ones((1, 1)))
    meeting = 19 / (0.15 + np.sqrt(0.15**2 + 0.0035 * 19))  # root of 0.0035 x^2 + 0.3 x - 19
    assert found.fit.change == pytest.approx([meeting], rel=0.06)
    assert len(clouds.seen) <= again.TIMES
    assert clouds.seen[0] == 19.0
    assert found.fit.by_retelling[COLUMNS[0]] == pytest.approx(found.fit.change[0] - 19.0)  # counts as a doubt


def test_a_line_does_not_lead_a_stiffness_to_nothing():
    """Nor farther than steps may go: less than none is no stiffness, and nothing leads back from none."""
    columns = [column for column in tunable("strain_stvk", MODEL) if column.parameter == "lame_mu"]
    best = replace(fitted(5.0), columns=tuple(columns), model=MODEL)
    for asked, kept in ((-1.2, 0.1), (-0.5, 0.5), (40.0, 10.0)):
        there = best.ahead(np.array([asked]))
        mu, was = (float(model.effects["strain_stvk"]["lame_mu"]) for model in (there, MODEL))
        assert mu == pytest.approx(kept * was)


@pytest.mark.usefixtures("plays")
def test_where_registering_does_not_matter_it_is_done_once():
    clouds = Law(lambda at: 5 + 0.02 * at)
    found = fitted_again(clouds, fitted(5.0), np.ones((1, 1)))
    assert clouds.seen == [5.0]
    assert found.fit.change == pytest.approx([5.1])


def test_what_was_measured_as_vertices_is_not_registered():
    study = Study([Scene.of(measured(*simulate(seconds=1.2, settle=2.0)))])
    assert study.registered_by(MODEL) is study
    assert fitted_again(study, fitted(5.0), np.ones((1, 1))) is None


@pytest.mark.parametrize(("whose", "again"), [("clouds", None), ("held-out clouds", Again)])
def test_what_could_not_be_registered_again_is_said(whose, again, monkeypatch):
    """In what is printed and on the page: errors there are of clouds as they were first."""

    def fitted_again(study: Study, best: Fit, variance: np.ndarray, weigh: bool) -> Again | None:
        assert study.registered_by(best.model) is study
        return again and again(study, best, study.respond(best.origin, best.columns))

    def lost(*_):
        raise CaphyError("square: the model does not follow its cloud")

    films = [measured(*simulate(seconds=1.2, settle=2.0, drag=0.6, count=5, tempo=tempo)) for tempo in (1.0, 1.2)]
    monkeypatch.setattr("caphy.refit.refit.fitted_again", fitted_again)
    monkeypatch.setattr("caphy.refit.study.all_registered", lost)
    monkeypatch.setattr(Study, "of_clouds", property(lambda _: True))
    found = refit(MODEL, films[:1], ("mass_damping",), films[1:])
    note = f"{whose} were not registered again by what was fitted: square: the model does not follow its cloud"
    assert found.notes == (note,) and not found.refused
    assert table(found).endswith(f"\nNote: {note}.")
    assert note in before_and_after("model", MODEL, found.model, [], Crew(), notes=found.notes)


def test_why_clouds_were_not_registered_again_is_said():
    vertices, clouds, followed = (
        SimpleNamespace(of_clouds=of_clouds, why_not=why)
        for of_clouds, why in ((False, ""), (True, "only 2 of 15 windows would be left"), (True, ""))
    )
    assert as_registered_first("clouds", vertices, False) == as_registered_first("clouds", clouds, True) == ()
    (said,) = as_registered_first("held-out clouds", clouds, False)
    assert said.startswith("held-out clouds") and said.endswith(": only 2 of 15 windows would be left")
    (said,) = as_registered_first("clouds", followed, False)
    assert said.endswith("flies apart")


def test_a_stiffness_is_told_nearer_the_truth_by_clouds_registered_with_it():
    """Registered by a model that lacks two thirds of it, clouds tell less than half of what is missing."""
    positions, keys = simulate(seconds=1.2, settle=2.0, lame=(20.9, 3 * 11.1))
    points = seen(clouds(positions, keys["faces"], 1500, 1e-3), keys, noise_mm=1.0)
    study = Study([registered(Scene.of(points), MODEL)])
    columns = [column for column in tunable("strain_stvk", MODEL) if column.parameter == "lame_mu"]
    responses = study.respond(MODEL, columns, "before")
    variance = study.variance(responses)
    first = fit(study, MODEL, columns, responses, Weighing.robust(responses, variance))
    found = fitted_again(study, first, variance)
    assert found is not None
    assert found.fit.origin is MODEL
    assert 0 < first.change[0] < 1.0
    assert found.fit.change == pytest.approx([2.0], rel=0.25)
    assert found.study.starts == study.starts
    assert found.fit.by_retelling[columns[0]] == pytest.approx(found.fit.change[0] - first.change[0])
    median, before = (
        np.median(np.concatenate([r.error for r in each])) for each in (found.fit.responses, found.before)
    )
    assert median < before
    falls_out_of_them = MODEL.with_effect("strain_stvk", lame_lambda=1e-6, lame_mu=1e-6)
    assert study.why_not == ""
    assert study.registered_by(falls_out_of_them) is study
    assert study.why_not != ""
    assert study.registered_by(MODEL) is not study and study.why_not == ""
