"""Diagnosis and refit on cloth that an independent explicit integrator moved."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from explicit_cloth import clouds, measured, seen, simulate

from caphy.cli import main
from caphy.commands import diagnose as commands
from caphy.commands.diagnose import Diagnose, _with_history
from caphy.diagnose import rivals
from caphy.diagnose.base import checked_scenes, from_base
from caphy.diagnose.diagnosis import Diagnosis, _concluded, diagnose
from caphy.diagnose.figures import figures, sentences
from caphy.diagnose.groups import Group
from caphy.diagnose.pictures import force_pictures
from caphy.diagnose.rivals import settle_rivals
from caphy.diagnose.search import Search, refitted, screen
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement, write_measurement
from caphy.measure.scene import Scene
from caphy.refit.again import Again
from caphy.refit.columns import addition
from caphy.refit.evidence import evidence
from caphy.refit.fit import Fit
from caphy.refit.heldout import Apart, HeldOut
from caphy.refit.refit import Refit, refit
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
DRAG = 0.6  # kg/m^2/s against the velocity: a rate of 3 1/s on cloth of 0.2 kg/m^2
HIDDEN, WRONG = "mass_damping", "air_drag_normal"


def taken(seed: int, seconds: float = 1.6, **hidden) -> Measurement:
    """The square; each seed sways at its own tempo."""
    return measured(*simulate(seconds, tempo=1 + 0.15 * seed, settle=2.0, **hidden), seed=seed)


@pytest.fixture(scope="module")
def plain() -> Measurement:
    return taken(0, 2.0)


@pytest.fixture(scope="module")
def dragged() -> tuple[Measurement, Measurement]:
    return taken(1, drag=DRAG), taken(2, drag=DRAG)


@pytest.fixture(scope="module")
def named(dragged):
    return diagnose(MODEL, dragged[:1], held_out=dragged[1:])


def test_a_planted_effect_is_named_measured_and_proven(named):
    assert named.verdict == "named"
    assert named.found == ("mass_damping",)
    rate = named.coefficients["mass_damping.rate"]
    assert abs(rate.value - DRAG / MODEL.density) < 0.1 * DRAG / MODEL.density
    assert rate.low < rate.value < rate.high
    assert named.held_out is not None
    assert named.held_out.after_mm < 0.7 * named.held_out.before_mm
    told = json.loads(json.dumps(figures(named), allow_nan=False))
    assert told["ranking"][0]["effect"] == "mass_damping"
    assert "mass_damping" in sentences(named)[0]


def test_nothing_is_named_where_nothing_is_missing(plain):
    found = diagnose(MODEL, [plain])
    assert found.verdict == "nothing"
    assert not found.found and not found.coefficients
    assert found.model == MODEL


def test_a_force_from_outside_the_library_is_flagged():
    def sewn_in(x, v, now):
        """The lower half is pushed to the left and the upper half to the right: no effect of the library."""
        push = np.zeros_like(x)
        push[:, 0] = np.where(np.arange(len(x)) < len(x) // 2, 2.0, -2.0)
        return push

    found = diagnose(MODEL, [taken(1, push=sewn_in), taken(2, push=sewn_in)])
    assert found.verdict == "none of these"
    assert found.depends_on == "place on the cloth"
    assert not found.found


def test_what_pulls_one_place_to_and_fro_is_flagged_with_its_beat():
    def shaken(x, v, now):
        """A quarter of the cloth, at 2.3 swings a second."""
        near = np.exp(-((np.arange(len(x)) // 9 - 6) ** 2 + (np.arange(len(x)) % 9 - 6) ** 2) / 4.0)
        return np.outer(near, (2.0, 0.0, 4.0)) * np.sin(2 * np.pi * 2.3 * now)

    found = diagnose(MODEL, [taken(1, push=shaken), taken(2, push=shaken)])
    assert found.verdict == "none of these"
    assert found.depends_on == "place on the cloth and time"
    assert found.outside.beat == pytest.approx(2.3, abs=0.15)
    assert f"({found.outside.beat:.1f} swings a second)" in sentences(found)[0]
    picture, *_ = force_pictures(found)
    assert "place on the cloth and time" in picture.caption


def test_a_wrong_effect_is_refused(dragged):
    wrong = refit(MODEL, dragged[:1], ("pressure",), dragged[1:])
    assert wrong.kept == ()
    assert wrong.model == MODEL
    assert "refused" in wrong.reason


def test_an_effect_that_is_not_needed_is_taken_back(dragged):
    both = refit(MODEL, dragged[:1], ("mass_damping", "pressure"), dragged[1:])
    assert both.kept == ("mass_damping",)
    assert both.removed == ("pressure",)


def test_parameters_that_are_off_are_called_that(plain):
    stiff = MODEL.with_effect("strain_stvk", lame_lambda=20.9 * 2.5, lame_mu=11.1 * 2.5)
    found = diagnose(stiff, [plain])
    assert found.verdict == "parameters"
    change = found.coefficients["strain_stvk.lame_mu"]
    assert abs(change.value - (1 / 2.5 - 1)) < 0.1


def test_what_base_measurements_show_is_not_named(plain, dragged):
    """A model that is off in the base measurements as well: only what came after is missing."""
    stiff = MODEL.with_effect("strain_stvk", lame_lambda=20.9 * 1.2, lame_mu=11.1 * 1.2)
    known = from_base(Study([Scene.of(plain)]), stiff)
    found = diagnose(stiff, dragged[:1], known, dragged[1:])
    assert found.found == ("mass_damping",)
    assert abs(found.coefficients["mass_damping.rate"].value - 3.0) < 0.3
    assert found.by_base is not None and found.held_out is not None
    assert found.held_out.before_mm == pytest.approx(found.by_base.after_mm, rel=1e-3)
    asked = Diagnose("stiff.json", (Path("after.npz"),), Path("out"), base=(Path("before.npz"),))
    first, second = _with_history(found, stiff, asked).history
    assert (first.note, second.note) == ("base: parameters were off", "diagnosis: lacked mass_damping")
    assert (first.data, second.added) == (("before",), ("mass_damping",))
    assert second.error_after < second.error_before == pytest.approx(first.error_after, rel=1e-3)
    # Not the fastest of the motions, in which the dashpots of their integrator show: 0.074 N s/m of 0.09.
    without = diagnose(stiff, [taken(1)], known, [plain])
    assert (without.verdict, without.found, without.coefficients) == ("parameters", (), {})
    assert abs(without.model.effects["strain_stvk"]["lame_mu"] / 11.1 - 1) < 0.05
    assert without.held_out is without.by_base is not None
    assert without.held_out.after_mm < 0.9 * without.held_out.before_mm and without.held_out.share > 0.1
    (revision,) = _with_history(without, stiff, asked).history
    assert revision.error_after == pytest.approx(1e-3 * without.held_out.after_mm, rel=1e-12)
    answer, *_, moved, left, _ = sentences(without)
    assert answer == "No effect is missing: the parameters of strain_stvk are off."
    assert "lame_mu" in moved
    assert f"a median distance of {known.median_mm:.2f} mm is left" in left
    again = refit(stiff, dragged[:1], ("mass_damping",), dragged[1:], learned=known)
    assert again.kept == ("mass_damping",)
    value, low, high, _ = again.coefficients["mass_damping.rate"]
    assert abs(value - 3.0) < 0.3 and low < value < high


def test_what_acts_in_contact_is_weighed_where_any_measurement_has_a_body(plain):
    """... though the first has none; there such an effect does nothing."""
    ball = trimesh.creation.icosphere(1, radius=0.1)
    still = np.broadcast_to(ball.vertices + np.array([0, -2, 0]), (len(plain), *ball.vertices.shape))
    near = replace(plain, body_vertices=still, body_faces=np.asarray(ball.faces, np.int32))
    study = Study([Scene.of(plain), Scene.of(near)])
    assert study.on_body and not Study([Scene.of(plain)]).on_body
    found = screen(study, MODEL.with_effect("body_contact"), MODEL)
    place = found.places["contact_thickness"] + found.places["body_friction"]
    assert not found.evidence.b[:, place].any()  # the ball is far away


def test_base_measurements_put_parameters_right_that_are_far_off(plain, dragged):
    """... and nothing else: what is in the model cannot be found to be missing. Clouds, below, put 2.5 times right."""
    wrong = MODEL.with_effect("strain_stvk", lame_lambda=20.9 * 0.4, lame_mu=11.1 * 0.4)
    known = from_base(Study([Scene.of(plain)]), wrong)
    assert list(known.model.effects) == list(wrong.effects)
    assert abs(known.model.effects["strain_stvk"]["lame_mu"] / 11.1 - 1) < 0.1
    added = refit(wrong, dragged[:1], ("mass_damping",), dragged[1:], learned=known)
    assert added.kept == ("mass_damping",)
    assert abs(added.coefficients["mass_damping.rate"][0] - 3.0) < 0.3


def test_base_clouds_are_registered_again_by_parameters_that_were_put_right():
    """Cloth registered by a mu of 2.5 times the true one is drawn as stiff: without that 14.1 are told for 11.1."""
    positions, keys = simulate(seconds=1.2, settle=2.0)
    points = seen(clouds(positions, keys["faces"], 1500, 1e-3), keys, noise_mm=1.0)
    wrong = MODEL.with_effect("strain_stvk", lame_lambda=20.9 * 2.5, lame_mu=11.1 * 2.5)
    known = from_base(Study(checked_scenes([points], wrong)), wrong)
    assert abs(known.model.effects["strain_stvk"]["lame_mu"] / 11.1 - 1) < 0.1


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda v, r: v * 1000, "give metres"),
        (lambda v, r: v[r.permutation(len(v))], "order of time"),
        (lambda v, r: v[:, r.permutation(v.shape[1])], "follow the cloth's mesh"),
        (lambda v, r: r.normal(0, 0.3, v.shape), "edges"),
        (lambda v, r: v[:20], "at least 4 windows"),
    ],
    ids=["millimetres", "shuffled frames", "another order of vertices", "all noise", "too few windows"],
)
def test_bad_measurements_get_no_name(plain, spoil, message):
    vertices = spoil(plain.vertices, np.random.default_rng(0))
    pins = plain.pinned_positions[: len(vertices)]
    with pytest.raises(CaphyError, match=message):
        diagnose(MODEL, [replace(plain, vertices=vertices, pinned_positions=pins)])


def test_the_commands_write_what_they_say_and_go_on_where_they_were_stopped(tmp_path, dragged, capsys, monkeypatch):
    for number, measurement in enumerate(dragged):
        write_measurement(measurement, tmp_path / f"m{number}.npz")
    (tmp_path / "model.json").write_text(MODEL.to_json())
    model, measured_path = str(tmp_path / "model.json"), str(tmp_path / "m0.npz")
    words, kept, told, write = ["diagnose", model, measured_path, "-o", str(tmp_path / "d")], [], [], commands.write

    def stopped(*found: object) -> None:
        raise KeyboardInterrupt

    def going_on(*found: object) -> None:
        told.extend(sorted(kept[0].iterdir()))
        write(*found)

    (tmp_path / "d").mkdir()
    (tmp_path / "d" / commands.PROOF).write_text("of another answer")
    monkeypatch.setattr(commands, "write", stopped)
    assert main(words) == 130
    kept.append(tmp_path / "d" / "unfinished")
    assert f"the same command goes on from {kept[0]}" in capsys.readouterr().err
    files = sorted(kept[0].iterdir())
    monkeypatch.setattr(commands, "write", going_on)
    assert main(words) == 0
    assert told == files and not kept[0].exists()  # nothing was found anew
    assert not (tmp_path / "d" / commands.PROOF).exists()
    said = capsys.readouterr().out
    assert "what an earlier run left" in said
    assert "caphy refit" in said and "--add mass_damping" in said
    assert json.loads((tmp_path / "d" / "diagnosis.json").read_text())["found"] == ["mass_damping"]
    page = (tmp_path / "d" / "diagnosis.html").read_text()
    assert "The model lacks mass_damping" in page
    assert Model.load(tmp_path / "d" / "model.json").history[-1].added == ("mass_damping",)
    assert page.count("data:image/png;base64") >= 3
    better = tmp_path / "better.json"
    proof = ["--held-out", str(tmp_path / "m1.npz")]
    assert main(["refit", model, measured_path, "--add", "mass_damping", *proof, "-o", str(better)]) == 0
    again = Model.load(better)
    assert "mass_damping" in again.effects
    assert again.history[-1].added == ("mass_damping",)
    assert again.history[-1].error_after < again.history[-1].error_before
    assert "before" in better.with_suffix(".html").read_text()
    assert not better.with_suffix(".unfinished").exists()
    refused = Refit(
        MODEL, (), (), {}, HeldOut(5.0, 4.9, None, *2 * (np.ones(1),), 0.0, 1.0), "does not hold", 0.1, True
    )
    monkeypatch.setattr("caphy.refit.refit.refit", lambda *_: refused)
    for add in ((), ("--add", "pressure")):  # a script that goes on with the new model must hear of it
        assert main(["refit", model, measured_path, *add, "-o", str(tmp_path / "none.json")]) == 1
        assert "does not hold\nThe model stays as it was" in capsys.readouterr().out
        assert not (tmp_path / "none.json").exists()


def test_what_clouds_tell_is_told_by_those_registered_again(named, apart, dragged, monkeypatch):
    """What is told, kept and held out is of the fit that agrees with its clouds."""
    seen_rates = []

    def again(study: Study, best: Fit, variance: np.ndarray, weigh: bool) -> Again:
        (rate,) = best.change
        model = best.model.with_effect(HIDDEN, rate=1.2 * rate)
        seen_rates.append(rate)
        told = replace(best, model=model, responses=study.respond(model, best.columns))
        return Again(study, told, study.respond(best.origin, best.columns))

    for module in ("caphy.diagnose.diagnosis", "caphy.refit.refit"):
        monkeypatch.setattr(f"{module}.fitted_again", again)
    found = _concluded(replace(named.search), named.study, MODEL, MODEL, None, apart, named.outside)
    refitted_to = refit(MODEL, dragged[:1], (HIDDEN,), dragged[1:])
    told = found.coefficients[f"{HIDDEN}.rate"].value, refitted_to.coefficients[f"{HIDDEN}.rate"][0]
    for rate, value, model, held in zip(
        seen_rates, told, (found.model, refitted_to.model), (found.held_out, refitted_to.held_out), strict=True
    ):
        assert value == pytest.approx(1.2 * rate)
        assert model.effects[HIDDEN]["rate"] == pytest.approx(1.2 * rate)
        windows = Study(checked_scenes(dragged[1:2], MODEL)).respond(model, ())
        errors = np.concatenate([window.error.ravel() for window in windows])
        assert held.after_mm == pytest.approx(1e3 * np.nanmedian(errors), rel=1e-3)
    said = f"clouds were registered again, once, by what was fitted to them; it moved {HIDDEN}.rate from"
    assert sentences(found)[-1] == f"Note: {said} {seen_rates[0]:.3g} to {told[0]:.3g}."


def test_what_clouds_registered_again_do_not_tell_is_taken_back(named, apart, dragged, monkeypatch):
    """As a viscosity that was named where only the time step differed, which came to 0.067 (0 to 0.137) N s/m."""

    def again(study: Study, best: Fit, variance: np.ndarray, weigh: bool) -> Again:
        before = study.respond(best.origin, best.columns)
        nothing = best.origin.with_effect(HIDDEN, rate=1e-6)
        told = evidence(before, variance, best.first.weight)
        return Again(study, replace(best, model=nothing, responses=before, evidence=told), before)

    for module in ("caphy.diagnose.diagnosis", "caphy.refit.refit"):
        monkeypatch.setattr(f"{module}.fitted_again", again)
    found = _concluded(replace(named.search), named.study, MODEL, MODEL, None, apart, named.outside)
    assert (found.verdict, found.found, found.coefficients) == ("nothing", (), {})
    assert found.model is MODEL
    assert any(f"{HIDDEN} was taken back" in note for note in found.notes)
    assert "of the misfit but does not hold, as the notes say." in sentences(found)[0]
    assert found.median_mm[0] == found.median_mm[1]
    assert found.held_out is not None and found.held_out.before_mm == found.held_out.after_mm
    refused = refit(MODEL, dragged[:1], (HIDDEN,), dragged[1:])
    assert refused.kept == () and refused.model is MODEL
    assert "refused" in refused.reason


def test_what_takes_cloth_away_from_where_it_was_seen_is_taken_back(named, apart):
    """As contact thickness of half a millimetre was named where only the time step differed, since held-out windows
    happened to lie nearer."""
    assert named.search.fit is not None
    worse = [replace(window, error=2 * window.error) for window in named.search.screens[0].responses]
    found = replace(named.search, fit=replace(named.search.fit, responses=worse))
    told = _concluded(found, named.study, MODEL, MODEL, None, apart, named.outside)
    assert (told.verdict, told.found) == ("nothing", ())
    (note,) = [note for note in told.notes if f"{HIDDEN} was taken back" in note]
    assert "where it was fitted the median distance rises from" in note


@pytest.fixture(scope="module")
def apart(named, dragged) -> Apart:
    return Apart(Study(checked_scenes(dragged[1:2], MODEL)), named.search.screens[0].variance)


def searched(named: Diagnosis, told: bool) -> Search:
    """The same search; unless ``told`` as if tangents had said nothing of its numbers."""
    screens = [screen if told else replace(screen, scores=[]) for screen in named.search.screens]
    return replace(named.search, terms=list(named.search.terms), screens=screens)


def mistaken(named: Diagnosis, told: bool) -> Search:
    """The same search, had it taken the wrong one."""
    found = searched(named, told)
    group, term = Group(WRONG, addition(WRONG)), found.terms[0]
    found.fit = refitted(named.study, found, [group], "the wrong one")
    found.terms = [replace(term, group=group, fit=found.fit, weighed={WRONG: 0.5, HIDDEN: 0.45}, even=())]
    return found


def test_what_the_search_took_by_mistake_is_put_right(named, apart):
    assert named.found == (HIDDEN,)
    found = mistaken(named, told=False)
    settle_rivals(named.study, found, apart)
    (term,) = found.terms
    assert term.group.name == HIDDEN
    assert WRONG not in [group.name for group in term.even]
    assert found.fit is term.fit and found.fit is not None
    rate = float(found.model.effects[HIDDEN]["rate"])
    assert rate == pytest.approx(named.coefficients[f"{HIDDEN}.rate"].value, rel=0.03)
    assert rate == pytest.approx(DRAG / MODEL.density, rel=0.06)  # the integrator damps edges a little, too


def test_what_is_right_stays(named, apart):
    found = searched(named, told=False)
    before = found.fit
    assert before is not None
    found.terms[0] = replace(found.terms[0], weighed={WRONG: 0.45, HIDDEN: 0.5})
    missed = named.study.respond(before.model, (), anew={"solver"})
    settle_rivals(named.study, found, apart)
    assert found.fit is before and found.terms[0].group.name == HIDDEN
    for then, now in zip(missed, named.study.respond(before.model, ()), strict=True):
        np.testing.assert_array_equal(now.residual, then.residual)  # not what steps do to the rival


def test_what_is_far_behind_is_not_tried_to_its_end(named, apart, monkeypatch):
    found = searched(named, told=False)
    before = found.fit
    found.terms[0] = replace(found.terms[0], weighed={WRONG: 0.45, HIDDEN: 0.5})
    monkeypatch.setattr(rivals, "retold", lambda *_: pytest.fail("told anew"))
    monkeypatch.setattr(rivals, "BEHIND", 1.0)
    settle_rivals(named.study, found, apart)
    assert found.fit is before and found.terms[0].even == named.search.terms[0].even
    monkeypatch.setattr(rivals, "BEHIND", 0.0)
    with pytest.raises(pytest.fail.Exception):
        settle_rivals(named.study, found, apart)


def test_both_are_named_where_what_is_held_out_says_otherwise(named, apart, monkeypatch):
    found = mistaken(named, told=False)
    before, errors = found.fit, apart.errors
    turned = lambda fitted: replace(errors(fitted), after_mm=-errors(fitted).after_mm)  # noqa: E731
    monkeypatch.setattr(apart, "errors", turned)
    settle_rivals(named.study, found, apart)
    assert found.fit is before and found.terms[0].group.name == WRONG
    assert [group.name for group in found.terms[0].even] == [HIDDEN]


def test_what_tangents_told_is_tried_no_more(named, apart):
    found = mistaken(named, told=True)
    before = found.fit
    settle_rivals(named.study, found, apart)
    assert found.fit is before and found.terms[0].group.name == WRONG


def only(name: str) -> Callable[..., bool]:
    """As if windows agreed only on how much there is of one effect."""
    return lambda _fit, columns, *_: columns[0].effect == name


def test_what_may_be_nothing_gives_way_to_what_surely_acts(named, apart, monkeypatch):
    """As hysteresis was taken for a viscosity of 2.10 N s/m, and then given up."""
    monkeypatch.setattr(rivals, "acts", only(HIDDEN))
    found, errors = mistaken(named, told=True), apart.errors
    turned = lambda fitted: replace(errors(fitted), after_mm=-errors(fitted).after_mm)  # noqa: E731
    monkeypatch.setattr(apart, "errors", turned)
    settle_rivals(named.study, found, apart)
    (term,) = found.terms
    assert term.group.name == HIDDEN and found.fit is term.fit
    assert [group.name for group in term.even] == [WRONG]  # which leaves less of what is held out


def test_what_may_be_nothing_does_not_take_the_place_of_what_surely_acts(named, apart, monkeypatch):
    monkeypatch.setattr(rivals, "acts", only(WRONG))
    found = mistaken(named, told=False)
    before = found.fit
    settle_rivals(named.study, found, apart)
    assert found.fit is before and found.terms[0].group.name == WRONG
    assert [group.name for group in found.terms[0].even] == [HIDDEN]
