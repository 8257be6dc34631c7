"""The rules by which explanations are let in, on made-up scores."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from caphy.commands.refit import RefitCommand, _with_history, table
from caphy.diagnose import base, diagnosis, figures, proof, search
from caphy.diagnose.diagnosis import Coefficient, unconverged, unproven
from caphy.diagnose.groups import Group
from caphy.diagnose.outside import outside
from caphy.diagnose.screen import Score
from caphy.diagnose.search import LEAST_WALD, LEAST_WALD_OVER_BASE, OWN, Search, Term, finalists, ranked
from caphy.effects.model import Model
from caphy.refit import intervals
from caphy.refit.across import Across
from caphy.refit.columns import Column, addition, extended, further, moved
from caphy.refit.evidence import Evidence, Weighing
from caphy.refit.fit import Fit
from caphy.refit.heldout import HeldOut
from caphy.refit.refit import Refit

DRAG, PRESSURE = Group("mass_damping", addition("mass_damping")), Group("pressure", addition("pressure"))
MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
STIFFNESS = Group("strain_stvk", (Column("strain_stvk", "lame_mu", None),), own=True)
EVEN = Weighing(np.ones((1, 1)), np.ones(5))


def screen(*scores: Score):
    """Scores as a screen has them, all of at least 10 % beyond chance."""
    best = sorted(scores, key=lambda score: -score.gain)
    return SimpleNamespace(scores=best, enough=lambda score: score.gain >= 0.1)


def score(group: Group, gain: float, wald: float = 100.0) -> Score:
    return Score(group, gain, wald, np.ones(1))


def labels(found) -> list[str]:
    return [each.group.label for each in found]


def test_parameters_that_base_measurements_told_must_explain_half_as_much_again():
    close, far = score(STIFFNESS, 0.2 * OWN - 0.01), score(STIFFNESS, 0.2 * OWN + 0.01)
    assert labels(finalists(screen(close, score(DRAG, 0.2)), True)) == ["mass_damping"]
    assert labels(finalists(screen(far, score(DRAG, 0.2)), True)) == ["parameters of strain_stvk", "mass_damping"]
    assert labels(finalists(screen(close, score(DRAG, 0.2)), False))[0] == "parameters of strain_stvk"


def test_of_what_gains_as_much_the_simplest_stands_first():
    wind = Score(Group("wind_normal", addition("wind_normal")), 0.302, 100.0, np.ones(4))
    drag, stiffness = score(DRAG, 0.301), score(STIFFNESS, 0.301 * OWN - 0.01)
    assert labels(ranked([wind, drag], True)) == ["mass_damping", "wind_normal"]
    assert labels(ranked([wind, score(DRAG, 0.27)], True))[0] == "wind_normal"
    assert labels(ranked([stiffness, wind, drag], True)) == ["mass_damping", "parameters of strain_stvk", "wind_normal"]
    assert labels(ranked([stiffness, wind, drag], False))[0] == "parameters of strain_stvk"
    assert labels(ranked([score(DRAG, -0.01), score(PRESSURE, -0.02)], True)) == ["mass_damping", "pressure"]


def test_they_explain_nothing_of_what_an_effect_leaves_over():
    last = screen(score(STIFFNESS, 0.9), score(DRAG, 0.2))
    assert labels(finalists(last, True, first=False)) == ["mass_damping"]
    assert not finalists(screen(score(STIFFNESS, 0.9)), True, first=False)


def test_an_estimate_within_its_error_is_no_explanation():
    assert LEAST_WALD > LEAST_WALD_OVER_BASE
    between = 0.5 * (LEAST_WALD + LEAST_WALD_OVER_BASE)
    assert not finalists(screen(score(DRAG, 0.2, between)))
    assert labels(finalists(screen(score(DRAG, 0.2, between)), True)) == ["mass_damping"]
    assert not finalists(screen(score(DRAG, 0.2, LEAST_WALD_OVER_BASE - 1)), True)


@pytest.mark.parametrize(("by", "told"), [(9.0, True), (-0.9, True), (3.0, False), (-0.6, False)])
def test_a_parameter_that_went_as_far_as_it_may_is_told(by, told):
    assert ("as far as it is moved (10 times)" in figures.at_limit(by)) == told


def test_a_frequency_is_surely_not_zero_and_proves_nothing():
    gust = (*addition("gust"), *further("gust"))
    numbers = {column.name: Coefficient(0.0, -1.0, 1.0, "m/s") for column in addition("gust")}
    numbers["gust.frequency"] = Coefficient(1.0, 0.01, 3.0, "Hz")
    found = Search(fit=SimpleNamespace(columns=gust))
    assert "different from zero" in unproven(0.2, None, diagnosis._acting(found, numbers))


def test_what_a_relative_change_loses_is_counted_from_where_it_ended():
    """Windows that ask for threefold of a stiffness, all of whose misfit of 4 comes back without it."""
    first, there = (Model(0.2, {"strain_stvk": {"lame_mu": mu}}) for mu in (10.0, 30.0))
    ends = Evidence(np.ones((5, 1, 1)), np.zeros((5, 1)), np.full(5, 4.0), np.ones(5), np.full(5, 40))
    fit = Fit(first, there, STIFFNESS.columns, ends, [], ends, 20.0, np.ones(5), EVEN)
    assert search._lost(fit, Term(STIFFNESS, fit, {})) == pytest.approx((2 / 3) ** 2 / (4 + (2 / 3) ** 2))


def test_what_was_taken_back_is_looked_at_again(monkeypatch):
    with_both, with_one = MODEL.with_effect("mass_damping", rate=1.0).with_effect("pressure", pressure=1.0), MODEL
    seen = []
    monkeypatch.setattr(search, "screen", lambda study, model, *_: seen.append(model) or SimpleNamespace(model=model))
    found = Search([SimpleNamespace(model=MODEL), SimpleNamespace(model=with_both)])
    found.fit = SimpleNamespace(model=with_both, share=0.2)
    search.looked_again(SimpleNamespace(), found, MODEL, None)
    assert not seen
    found.fit = SimpleNamespace(model=with_one, share=0.2)
    search.looked_again(SimpleNamespace(), found, MODEL, None)
    assert seen == [with_one] and found.screens[-1].model is with_one


def test_what_explains_far_less_than_the_best_is_not_refitted():
    assert labels(finalists(screen(score(DRAG, 0.9), score(PRESSURE, 0.2)))) == ["mass_damping"]
    assert labels(finalists(screen(score(DRAG, 0.3), score(PRESSURE, 0.2)))) == ["mass_damping", "pressure"]


@pytest.mark.parametrize(("so_far", "wanted"), [(0.0, 2.0), (4.0, 1.0), (9.0, 0.0)])
def test_parameters_grow_threefold_at_a_time_and_tenfold_in_all(so_far, wanted):
    model = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
    columns = STIFFNESS.columns
    there = moved(extended(model, columns), columns, np.array([so_far]))
    known = Evidence(np.ones((5, 1, 1)), np.full((5, 1), 1e3), np.full(5, 1e7), np.ones(5), np.full(5, 100))
    fit = Fit(model, there, columns, known, [], known, 1.0, np.ones(5), EVEN)
    assert fit.step == pytest.approx([wanted])


@pytest.mark.parametrize(("promise", "goes_on"), [(0.01, False), (0.03, True)])
def test_a_further_effect_that_cannot_come_to_enough_is_not_fitted_to_the_end(promise, goes_on, monkeypatch):
    """5 % of what is left are asked for; 1 % is there, and twice what the next step promises may come."""
    fit = SimpleNamespace(promise=promise * 300.0, converged=False)
    found = Search([SimpleNamespace(needed=0.02, misfit=300.0, variance=None, evidence=SimpleNamespace(weight=None))])
    found.terms = [Term(DRAG, fit, {})]
    near, asked = score(PRESSURE, 0.2 * search.SMALL), []
    monkeypatch.setattr(search, "finalists", lambda *_: [near])
    monkeypatch.setattr(search, "_told_by_tangents", lambda *_: (near, {"pressure": fit}))
    monkeypatch.setattr(search, "_more", lambda *_: 0.01)
    monkeypatch.setattr(search, "refined", lambda *_: asked.append(1) or fit)
    assert search._next_term(SimpleNamespace(), found, True, False) is None
    assert bool(asked) == goes_on


@pytest.mark.parametrize(
    ("share", "held_out", "own", "slight"),
    [
        (0.03, False, 0.0, None),
        (0.03, True, 0.0, True),
        (0.03, True, 0.8, True),
        (0.03, True, 0.9, None),  # a parameter that is off explains as much
        (0.06, True, 0.9, False),
    ],
)
def test_a_slight_further_effect_is_let_in_where_held_out_windows_can_prove_it(
    share, held_out, own, slight, monkeypatch
):
    fit = SimpleNamespace(promise=0.0, converged=True, misfit=290.0, share=0.3)
    near = score(PRESSURE, 0.2 * search.SMALL)
    known = SimpleNamespace(weight=None)
    scores = [near, score(STIFFNESS, own * near.gain)]
    found = Search([SimpleNamespace(needed=0.02, misfit=300.0, variance=None, evidence=known, scores=scores)])
    found.terms = [Term(DRAG, fit, {})]
    monkeypatch.setattr(search, "finalists", lambda *_: [near])
    monkeypatch.setattr(search, "_told_by_tangents", lambda *_: (near, {"pressure": fit}))
    monkeypatch.setattr(search, "_more", lambda *_: share)
    monkeypatch.setattr(search, "retold", lambda *_: fit)
    term = search._next_term(SimpleNamespace(), found, True, held_out)
    assert (None if term is None else term.slight) == slight
    assert term is None or (term.weighed, term.took) == ({"pressure": near.gain}, {"pressure": fit.share})


def held_out(share: float, error: float, after_mm: float = 2.95) -> HeldOut:
    return HeldOut(3.0, after_mm, 1.5, np.full(4, 3.0), np.full(4, after_mm), share, error)


@pytest.mark.parametrize(
    ("errors", "believed"),
    [
        (held_out(0.10, 0.03), True),
        (held_out(0.014, 0.013), False),  # no more than chance
        (held_out(0.02, 0.005), False),  # sure, but a tenth of what was promised
        (held_out(0.05, 0.02), True),  # a third, or nearly so
        (held_out(0.0, 0.1, after_mm=2.8), True),  # the median tells what the misfit cannot
        (held_out(-0.003, 0.053, after_mm=2.8), False),  # ... unless it rises: an added mass that is not there
        (held_out(0.10, 0.03, after_mm=3.05), False),  # the error must fall
        (held_out(-0.2, 0.05), False),
        (held_out(0.1, np.inf), False),  # one window knows no error of its own
    ],
)
def test_what_is_found_must_hold_on_held_out_measurements(errors, believed):
    numbers = {"mass_damping.rate": Coefficient(1.0, 0.5, 1.5, "1/s")}
    assert (unproven(0.2, errors, numbers) == "") is believed
    assert unproven(0.2, None, numbers) == ""


@pytest.mark.parametrize(
    ("fallen", "share", "believed"),
    [
        ("+++++", 0.02, True),  # 1 of 32 by chance
        ("++++", 0.02, False),  # 1 of 16
        ("++++-", 0.02, False),
        ("+++++++++-", 0.02, True),
        ("++++++++--", 0.02, False),  # 5.5 % by chance
        ("+++++", -0.02, False),  # the misfit rises, by more than its error
    ],
)
def test_an_error_that_falls_in_nearly_all_windows_is_believed(fallen, share, believed):
    """Of a few windows a standard error is hardly known; the sign test asks how often chance lets so many fall."""
    after = np.array([2.9 if each == "+" else 3.1 for each in fallen])
    errors = HeldOut(3.0, 2.95, 1.5, np.full(len(after), 3.0), after, share, 0.015)
    assert (unproven(0.06, errors, {"mass_damping.rate": Coefficient(1.0, 0.5, 1.5, "1/s")}) == "") is believed


class Told:
    """A study that notes of which models errors are told, and is tried on aside."""

    def __init__(self, aside: bool = False) -> None:
        self.told, self.aside = [], aside

    def likewise(self) -> Told:
        return Told(True)

    def tell(self, model: str, what: str) -> None:
        self.told.append(model)


@pytest.mark.parametrize(
    ("medians", "kept"),
    [
        ({"both": 2.0, "drag": 2.3, "pressure": 2.6}, ["mass_damping", "pressure"]),
        ({"both": 2.4, "drag": 2.3, "pressure": 2.6}, ["mass_damping"]),
        ({"both": 2.3, "drag": 2.3, "pressure": 2.6}, ["mass_damping"]),  # costs nothing
        ({"both": 2.4, "drag": 2.5, "pressure": 2.2}, ["mass_damping", "pressure"]),  # the first was found first
    ],
)
def test_each_further_effect_must_lower_the_held_out_median(medians, kept, monkeypatch):
    def without(study, found, term):
        found.terms = [other for other in found.terms if other is not term]
        called = "drag" if term.group is PRESSURE else "pressure"
        found.fit = SimpleNamespace(called=called, model=called)
        assert study.aside

    monkeypatch.setattr(proof, "take_back", without)
    both = SimpleNamespace(called="both", model="both")
    before = Search(terms=[Term(group, SimpleNamespace(), {}) for group in (DRAG, PRESSURE)], fit=both)  # type: ignore
    study = Told()
    found = proof.each_proven(study, before, lambda fit: held_out(0.1, 0.03, medians[fit.called]))  # type: ignore
    assert [term.group.label for term in found.terms] == kept
    assert len(before.terms) == 2
    assert study.told == ([] if len(kept) == 2 else ["drag"])  # of what stays, not of what was tried


@pytest.mark.parametrize(
    ("lost", "held_out", "left"),
    [
        (0.02, False, [("pressure", False)]),  # next to nothing
        (0.02, True, [("mass_damping", True), ("pressure", False)]),  # held-out windows must prove it
        (0.005, True, [("pressure", False)]),
        (0.04, True, [("mass_damping", False), ("pressure", False)]),
    ],
)
def test_what_costs_little_is_taken_back_or_must_be_proven(lost, held_out, left, monkeypatch):
    def without(study, found, term):
        found.terms = [other for other in found.terms if other is not term]

    monkeypatch.setattr(search, "_lost", lambda *_: lost)
    monkeypatch.setattr(search, "take_back", without)
    terms = [Term(group, SimpleNamespace(), {}) for group in (DRAG, PRESSURE)]  # type: ignore
    found = Search([SimpleNamespace(needed=0.01)], terms, fit=SimpleNamespace())  # type: ignore
    search._eliminate(SimpleNamespace(), found, held_out)  # type: ignore
    assert [(term.group.label, term.slight) for term in found.terms] == left


@pytest.mark.parametrize(
    ("with_it", "kept"),
    [
        ([2.29, 2.29, 2.29, 2.29, 2.29], True),  # 1 of 32 by chance
        ([2.29, 2.29, 2.29, 2.29, 2.31], False),
        ([2.1, 2.1, 2.31, 2.31, 2.1], True),  # by more than 3 %
        ([2.31, 2.31, 2.31, 2.31, 2.31], False),
    ],
)
def test_a_slight_effect_must_lower_held_out_errors_by_much_or_nearly_everywhere(with_it, kept, monkeypatch):
    def without(study, found, term):
        found.terms, found.fit = found.terms[:1], SimpleNamespace(model="drag")

    def judged(fit):
        after = np.array(with_it if fit.model == "both" else [2.3] * 5)
        return HeldOut(3.0, float(np.median(after)), 1.5, np.full(5, 3.0), after, 0.1, 0.03)

    monkeypatch.setattr(proof, "take_back", without)
    terms = [Term(DRAG, SimpleNamespace(), {}), Term(PRESSURE, SimpleNamespace(), {}, slight=True)]  # type: ignore
    found = proof.each_proven(Told(), Search(terms=terms, fit=SimpleNamespace(model="both")), judged)  # type: ignore
    assert (len(found.terms) == 2) is kept


def test_numbers_that_may_all_be_zero_name_nothing():
    unsure, sure = Coefficient(0.5, -0.1, 1.1, "Pa"), Coefficient(-0.5, -0.9, -0.1, "Pa")
    assert "different from zero" in unproven(0.2, None, {"a": unsure, "b": unsure})
    assert unproven(0.2, held_out(0.2, 0.01), {"a": unsure, "b": sure}) == ""


@pytest.mark.parametrize(
    ("drag", "pressure", "doubted"),
    [
        ((0.5, 1.5), (-0.1, 0.3), "pressure"),
        ((-0.5, 1.5), (0.1, 0.3), "mass_damping"),
        ((-0.5, 1.5), (-0.1, 0.3), "pressure"),  # the one that was found last
        ((0.5, 1.5), (-0.3, -0.1), None),
    ],
)
def test_of_several_effects_one_that_may_be_zero_is_doubted(drag, pressure, doubted, monkeypatch):
    told = {"mass_damping.rate": drag, "pressure.pressure": pressure}
    monkeypatch.setattr(intervals, "intervals", lambda *_: {n: (sum(e) / 2, *e, "1") for n, e in told.items()})
    found = Search(terms=[Term(group, SimpleNamespace(), {}) for group in (DRAG, PRESSURE)], fit=SimpleNamespace())
    term = diagnosis._doubtful(found, None, 1)
    assert (None if term is None else term.group.label) == doubted
    found.terms = found.terms[1:]
    assert diagnosis._doubtful(found, None, 1) is None  # what stands alone is not taken back here


@pytest.mark.parametrize(
    ("fits", "left"),
    [
        ([((3.455, -0.387), 0.141), ((-0.2,), 0.09)], ["strain_stvk.lame_mu"]),  # 30 % too much of mu
        ([((9.0, -0.442), 0.11), ((-0.161,), 0.085)], ["strain_stvk.lame_mu"]),  # neither at once, mu alone
        ([((6.345, -0.272), 0.072), ((0.022,), 0.003)], []),  # nothing wrong
        ([((9.0, -0.35), 0.5)], ["strain_stvk.lame_lambda", "strain_stvk.lame_mu"]),  # too much to be a mesh's doing
        ([((-0.9, 0.35), 0.13), ((0.3,), 0.06)], ["strain_stvk.lame_mu"]),
        ([((1.5, -0.35), 0.2)], ["strain_stvk.lame_lambda", "strain_stvk.lame_mu"]),
        ([((0.4, -0.71), 0.298)], ["strain_stvk.lame_lambda", "strain_stvk.lame_mu"]),  # far, for much
        ([((0.2, -0.3), 0.04), ((0.2,), 0.03)], []),
        ([((0.02, -0.03), 0.04)], []),  # not far, but for too little
        ([((0.0, 0.0), 0.0)], []),  # roll-outs did not agree
    ],
)
def test_parameters_that_go_far_for_little_are_left_alone(fits, left, monkeypatch):
    """Lambda times seven beside a softer mu is what a mesh that locks asks for."""
    columns = [Column("strain_stvk", name, None) for name in ("lame_lambda", "lame_mu")]
    answers = iter(fits)

    def fitted(_study, _model, tried, *_):
        change, share = next(answers)
        return SimpleNamespace(columns=tuple(tried), change=np.array(change), share=share)

    monkeypatch.setattr(base, "fit", fitted)
    monkeypatch.setattr(base, "picked", lambda *_: [])
    monkeypatch.setattr(base, "_far_off", lambda *_: columns)
    look = SimpleNamespace(columns=tuple(columns), probed=[], weighing=None)
    found = base._fitted(None, look, None)
    assert ([] if found is None else [column.name for column in found.columns]) == left
    assert next(answers, None) is None  # all were asked for


def test_an_effect_that_is_fitted_on_is_named_once():
    found = Search()
    terms = [Term(Group(name, ()), SimpleNamespace(share=share), {}) for name, share in
             (("gust", 0.1), ("pressure", 0.2), ("gust", 0.3))]  # fmt: skip
    for term in terms:
        found.accept(term)
    assert found.terms == [terms[2], terms[1]]
    found.accept(Term(Group("gust", (), own=True), SimpleNamespace(share=0.4), {}))
    assert [term.group.label for term in found.terms] == ["gust", "pressure", "parameters of gust"]


def test_clouds_that_moved_parameters_do_not_follow_are_named():
    moved = SimpleNamespace(changed={"strain_stvk.lame_mu": 1.5}, why_not="frame 3: no face is near")
    stayed = SimpleNamespace(changed={}, why_not="")
    study, failed = SimpleNamespace(why_not=""), SimpleNamespace(study=SimpleNamespace(why_not="frame 7: none"))
    moved.before, moved.median_mm = None, 2.0
    assert diagnosis._not_by_moved(study, None, None) == diagnosis._not_by_moved(study, stayed, failed) == []
    _, of_base, _ = figures.learned_of(moved)
    assert of_base.startswith("Base clouds") and of_base.endswith("parameters: frame 3: no face is near.")
    (held_out,) = diagnosis._not_by_moved(study, moved, failed)
    assert held_out.startswith("held-out clouds") and held_out.endswith("moved: frame 7: none")


def probed(gain: float, library: float):
    """A screen in which a force by the velocity takes away a share of the misfit, in each of ten windows."""
    null = np.full(10, 100.0)
    told = {"velocity": SimpleNamespace(misfit=(1 - gain) * null, change=np.zeros(1), beat=None)}
    flexible = SimpleNamespace(told=told, gains={"velocity": gain}, null=null)
    return SimpleNamespace(flexible=flexible, scores=[score(DRAG, library)], needed=0.01)


@pytest.mark.parametrize(("left", "flagged"), [(0.025, False), (0.06, True)])
def test_what_is_left_after_an_effect_must_be_worth_a_further_one(left, flagged):
    """As a quadratic wind was called none of these, of which a force by the velocity took 2 % of what it left over."""
    first, last = probed(0.3, 0.5), probed(left, 0.002)
    after = outside(SimpleNamespace(screens=[first, last], terms=[SimpleNamespace(group=DRAG)]))
    assert (after.beats, after.after) == (flagged, ("mass_damping",))
    alone = probed(0.025, 0.002)
    assert outside(SimpleNamespace(screens=[alone], terms=[])).beats


def test_the_race_is_run_on_by_those_that_may_still_come_near_the_best(monkeypatch):
    """Share so far, what a further step promises of the misfit, whether it has arrived."""
    runners = {
        "pressure": (0.50, 0.00, False),
        "hopeful": (0.20, 0.11, False),  # may take away twice as much
        "behind": (0.20, 0.09, False),
        "arrived": (0.45, 0.00, True),
    }
    ran = []

    def fitted(study, found, score, rounds):
        share, promise, converged = runners[score.group.label]
        assert rounds <= search._HEATS
        return SimpleNamespace(label=score.group.label, share=share, promise=promise, converged=converged)

    def refined(study, fit, what, rounds):
        assert rounds == search.ROUNDS - search._HEATS
        ran.append(fit.label)
        return SimpleNamespace(**vars(fit) | {"share": 0.9})

    monkeypatch.setattr(search, "_fitted", fitted)
    monkeypatch.setattr(search, "refined", refined)
    last = SimpleNamespace(misfit=1.0)
    scores = [SimpleNamespace(group=SimpleNamespace(label=label)) for label in runners]
    found = SimpleNamespace(screens=[last])
    fits = search._raced(None, found, scores, search.ROUNDS)
    assert ran == ["pressure", "hopeful"]
    assert [fits[label].share for label in runners] == [0.9, 0.9, 0.2, 0.45]
    assert not search._raced(None, found, scores, 1)["hopeful"].converged  # one step alone goes no further
    assert ran == ["pressure", "hopeful"]


def test_without_held_out_measurements_no_motion_may_speak_against_the_others():
    sure = {"mass_damping.rate": Coefficient(1.0, 0.5, 1.5, "1/s")}
    assert "rises by 51 % (error 9 %)" in unproven(0.2, Across(-0.51, 0.09, -0.3), sure)
    assert unproven(0.2, Across(-0.51, 0.40, -0.5), sure) == ""  # one window alone tells nothing for sure
    assert unproven(0.2, Across(0.1, 0.02, 0.01), sure) == ""


def test_frames_in_which_the_solver_did_not_converge_are_told():
    windows = [SimpleNamespace(converged=np.array(each)) for each in ([True] * 8, [True] * 6 + [False] * 2)]
    (note,) = unconverged(windows)
    assert "did not converge in 2 of the windows' 16 frames" in note
    assert unconverged(windows[:1]) == []


def test_a_change_in_proportion_is_told_as_one_whatever_the_unit():
    """A coefficient of friction has the unit 1 itself."""
    assert Column("body_friction", "coefficient", None).unit == "relative"
    change = Coefficient(1.08, 0.988, 1.17, "relative")
    said = figures._coefficient("body_friction.coefficient", change)
    assert said == "body_friction.coefficient changes by +108 % (95 %: +99 to +117 %)."
    said = figures._coefficient("body_friction.coefficient", Coefficient(0.3, 0.2, 0.4, "1"))
    assert said == "body_friction.coefficient = 0.3 (95 %: 0.2 to 0.4)."
    held = HeldOut(3.0, 2.0, None, np.ones(4), np.ones(4), 0.5, 0.1)
    numbers = {"body_friction.coefficient": (1.08, 0.988, 1.17, "relative"), "body_friction.slip": (0.3, 0.2, 0.4, "1")}
    first, second, *_ = table(Refit(MODEL, (), (), numbers, held, "", 0.5)).splitlines()[1:]
    assert first.split() == [
        "body_friction.coefficient",
        "+108",
        "%",
        "+98.8",
        "to",
        "+117",
        "%",
        "of",
        "what",
        "it",
        "was",
    ]
    assert second.split() == ["body_friction.slip", "0.3", "0.2", "to", "0.4"]


def test_what_base_measurements_moved_is_a_revision_of_its_own():
    softer = MODEL.with_effect("strain_stvk", lame_mu=7.0)
    learned = base.Base(softer, (), {}, *[None] * 3, 0.0, 0.3, {"strain_stvk.lame_mu": -0.3}, {}, 0.0, 0.0, 2.0)
    found = Refit(
        softer.with_effect("mass_damping", rate=3.0), ("mass_damping",), (), {},
        HeldOut(6.7, 2.1, None, np.ones(4), np.ones(4), 0.5, 0.1), "", 0.5,
    )  # fmt: skip
    command = RefitCommand("m.json", (Path("a/drag1.npz"),), Path("better.json"), base=(Path("b/plain.npz"),))
    first, second = _with_history(command, MODEL, found, learned).history
    assert (first.data, first.added, first.error_before) == (("plain",), (), None)
    assert (second.data, second.added, second.error_before) == (("drag1",), ("mass_damping",), 6.7e-3)
    (only,) = _with_history(command, MODEL, found, None).history
    assert only.added == ("mass_damping",) and "strain_stvk.lame_mu" in only.parameters


def test_of_several_parameters_all_are_off():
    """Not one or the other."""
    found = base.Earlier(MODEL, ("air_drag_normal", "shrinkage"), (1.0, 2.0))
    learned = base.Base(MODEL, (), {}, *[None] * 3, 0.0, 0.3, {}, {}, 0.0, 0.0, 2.0, before=found)
    assert "before air_drag_normal and shrinkage came into the model" in figures.learned_of(learned)[0]
