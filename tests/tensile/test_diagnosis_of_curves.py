"""Diagnosis and refit on tensile tests made by hand, and on the real knits."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_form import Sheet, measured, softened

from caphy.cli import main
from caphy.effects import registry
from caphy.effects.model import Model
from caphy.effects.own import use_file
from caphy.effects.presets import fabric_model
from caphy.errors import CaphyError
from caphy.io.measurements import ForceCurve, read_force_curves
from caphy.kept import Kept
from caphy.measure.uniaxial import model_curve
from caphy.tensile import diagnose_curves, refit_curves
from caphy.tensile.between import TOO_FEW
from caphy.tensile.checks import usable
from caphy.tensile.diagnosis import _verdict
from caphy.tensile.errors import _floor
from caphy.tensile.fit import Bench, Fit
from caphy.tensile.loadings import prepared
from caphy.tensile.report import _slugs, write
from caphy.tensile.strip import Strip
from caphy.tensile.transfer import _scaled
from caphy.tensile.unexplained import dependence, drift

LAMBDA, MU, TOP = 20.0, 15.0, 0.25


def model(lame_lambda: float = LAMBDA, lame_mu: float = MU) -> Model:
    values = {"lame_lambda": lame_lambda, "lame_mu": lame_mu}
    return Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": values})


def isotropic(**more: float) -> Sheet:
    return Sheet(LAMBDA + 2 * MU, LAMBDA + 2 * MU, LAMBDA, **more)


def number(diagnosis, name: str):
    return next(c for c in diagnosis.coefficients if c.name == name)


def test_a_model_that_is_right_is_left_alone():
    answers = [diagnose_curves(model(), measured(isotropic(), TOP, seed)) for seed in range(4)]
    assert [a.verdict for a in answers] == ["nothing"] * 4
    assert all(not a.found and not a.found_used for a in answers)


def test_wrong_parameters_are_answered_as_such():
    answer = diagnose_curves(model(1.4 * LAMBDA, 0.7 * MU), measured(isotropic(), TOP, 5))
    assert answer.verdict == "parameters"
    for name, true in (("strain_stvk.lame_lambda", LAMBDA), ("strain_stvk.lame_mu", MU)):
        assert number(answer, name).interval[0] <= true <= number(answer, name).interval[1]


def test_a_stiffening_is_found_and_recovered():
    answer = diagnose_curves(model(), measured(isotropic(fourth=1500.0), TOP, 1))
    assert (answer.verdict, answer.found, answer.found_used) == ("named", ("strain_stiffening",), ())
    found = number(answer, "strain_stiffening.stiffness")
    assert found.interval[0] <= 1500 <= found.interval[1] and found.unit == "N/m"
    assert answer.summary["relative"]["with effects"] < 0.2 * answer.summary["relative"]["parameters"]
    assert answer.complete


def test_what_was_fitted_before_it_was_stopped_is_not_fitted_again(tmp_path, monkeypatch):
    curves, kept = measured(isotropic(fourth=1500.0), TOP, 1), Kept(tmp_path / "kept")
    asked: list[int] = []
    curve = Strip.curve
    monkeypatch.setattr(Strip, "curve", lambda self, *of: asked.append(len(asked)) or curve(self, *of))

    def run(kept: Kept, fits: float = np.inf) -> tuple[list[object], int]:
        """What is told, and how often a strip was asked; stopped after a number of fits."""
        asked.clear()
        made: list[str] = []

        def say(what: str) -> None:
            made.append(what)
            if len(made) > fits:
                raise KeyboardInterrupt

        answer = diagnose_curves(model(), curves, say=say, kept=kept)
        return [answer.sentences, *(c.value for c in answer.coefficients)], len(asked)

    told, cost = run(Kept())
    with pytest.raises(KeyboardInterrupt):
        run(kept, 2)
    before = set(kept.folder.iterdir())
    again, less = run(kept)
    assert again == told and less < cost
    after = set(kept.folder.iterdir())
    assert before and before < after
    assert (run(kept)[0], set(kept.folder.iterdir())) == (told, after)
    diagnose_curves(model(lame_mu=2 * MU), curves, kept=kept)
    assert set(kept.folder.iterdir()) > after


@pytest.mark.parametrize("mu", [MU, 0.6 * MU])
def test_directions_that_differ_are_found_beside_the_mu_that_was_given(mu):
    """Sheets of lambda + 2 mu + 40 along the weft and lambda + 2 mu along the warp. A pull along the threads cannot
    tell mu from a stiffness of both, so it is held: at what the user gave, or the numbers would be of another model."""
    answer = diagnose_curves(model(lame_mu=mu), measured(Sheet(90.0, 50.0, LAMBDA), TOP, 0))
    assert answer.found == ("weft_warp_stiffness",)
    weft, warp = (number(answer, f"weft_warp_stiffness.{way}").value for way in ("weft", "warp"))
    assert weft - warp == pytest.approx(40, rel=0.1)
    assert 0.5 * (weft + warp) == pytest.approx(20 + 2 * (MU - mu), abs=2.5)
    assert answer.models["cloth"][0].effects["strain_stvk"]["lame_mu"] == mu
    assert any("bias" in sentence and "lame_mu is held" in sentence for sentence in answer.ambiguity)


@pytest.mark.parametrize("name", ["gray-interlock", "navy-sparkle-sweat"])
def test_a_measured_fabric_is_right_of_its_own_curve(name):
    """Pulled along the warp, its energy has a cliff where it is stretched alike both ways."""
    fabric, curves = fabric_model(name), []
    random, strain = np.random.default_rng(0), np.linspace(0, 0.2, 80)
    for direction in ("weft", "warp"):
        told = model_curve(fabric, strain, direction)
        curves += [
            ForceCurve("interlock", direction, k, strain, told.transverse, told.force * (1 + 0.02 * random.normal()))
            for k in range(1, 5)
        ]
    assert diagnose_curves(fabric, curves).verdict == "nothing"


def test_repeats_that_agree_exactly_accuse_nobody():
    """What they differ by is then the least that is counted with, 1 % of the force, and not nothing."""
    exact = [
        replace(curve, loading=k) for curve in measured(isotropic(), TOP, loadings=1, scatter=0.0) for k in (1, 2, 3)
    ]
    assert diagnose_curves(model(), exact).verdict == "nothing"


@pytest.mark.parametrize("rows", [200, 12])
def test_how_much_too_soft_does_not_depend_on_how_often_was_sampled(rows):
    """Cloth 25 % stiffer than the model, which so lacks 20 % of the force at every strain."""
    strain, stiffer = np.linspace(0, TOP, rows), Sheet(*(1.25 * k for k in (LAMBDA + 2 * MU, LAMBDA + 2 * MU, LAMBDA)))
    curves = [
        ForceCurve("cloth", way, k, strain, narrow, force * (1 + 0.002 * k))
        for way in ("weft", "warp")
        for force, narrow in [stiffer.curve(strain, way)]
        for k in (1, 2, 3)
    ]
    bench = Bench.of(model(), prepared(curves)[0]["cloth"], frozenset({"strain_stvk"}), Kept())
    residual = bench.residual(bench.curves((), np.zeros(0)))
    told = dependence({"cloth": Fit(bench, (), np.zeros(0), residual, np.zeros((*residual.shape, 0)))}).sentences
    assert len(told) == 2
    assert all(sentence.count("20 % too soft") == 3 for sentence in told)


def test_dry_friction_is_found():
    answer = diagnose_curves(model(), measured(isotropic(friction=1.0), TOP, 0))
    assert answer.found == ("hysteresis",)
    assert number(answer, "hysteresis.friction").value == pytest.approx(1.0, rel=0.1)


def test_softening_after_the_first_loading_is_told_from_a_shape():
    curves = measured(Sheet(90.0, 50.0, LAMBDA), TOP, 0, law=softened(0.25))
    answer = diagnose_curves(model(), curves)
    assert (answer.found, answer.found_used) == (("weft_warp_stiffness",), ("softening",))
    share = number(answer, "softening.share")
    assert share.interval[0] <= 0.25 <= share.interval[1] and share.used
    first, used = answer.models["cloth"]
    assert "softening" in used.effects and "softening" not in first.effects


def plateau(strain: np.ndarray, force: np.ndarray, loading: int) -> np.ndarray:
    """Threads that slip at constant tension from 8 % to 16 %."""
    start, stop = (force[np.searchsorted(strain, at)] for at in (0.08, 0.16))
    return np.where(strain < 0.08, force, start + np.maximum(0.0, force - stop) * (strain > 0.16))


def wavy(strain: np.ndarray, force: np.ndarray, loading: int) -> np.ndarray:
    return force * (1 + 0.5 * np.sin(40 * strain))


def fading(strain: np.ndarray, force: np.ndarray, loading: int) -> np.ndarray:
    return force * 0.85 ** (loading - 1)


@pytest.mark.parametrize("law", [plateau, wavy, fading])
def test_shapes_from_outside_the_library_are_flagged(law):
    answer = diagnose_curves(model(), measured(isotropic(), TOP, 0, law=law))
    assert answer.verdict == "none of these"
    depends = "loading number" if law is fading else "strain"
    assert depends in " ".join(answer.sentences)


def test_held_out_loadings_are_foretold():
    curves = measured(isotropic(fourth=1500.0), TOP, 2)
    away = [curve for curve in curves if curve.loading == 4]
    said: list[str] = []
    answer = diagnose_curves(model(), [c for c in curves if c not in away], away, said.append)
    assert {"its own parameters on cloth", "strain_stiffening on cloth"} <= set(said)
    assert [(e.direction, e.loading) for e in answer.loadings] == [("weft", 4), ("warp", 4)]
    told = {stage: sum(e.rms[stage] for e in answer.loadings) for stage in ("as given", "with effects")}
    floor = sum(e.floor or np.nan for e in answer.loadings)  # of one alone it may be met by chance
    assert told["with effects"] < 1.6 * floor < 0.3 * told["as given"]


def test_a_direction_that_was_not_learned_from_is_foretold_too():
    curves = measured(isotropic(), TOP, 2)
    learned, away = ([c for c in curves if c.direction == direction] for direction in ("weft", "warp"))
    answer = diagnose_curves(model(), learned, away[:1])
    assert [(e.direction, e.loading) for e in answer.loadings] == [("warp", 1)]


def test_a_fabric_left_out_with_one_loading_of_each_direction_is_told_by_the_others_numbers(tmp_path):
    """Of its own numbers none could be tried on another of its loadings."""
    curves = measured(isotropic(fourth=1500.0), TOP, 1)
    once = [replace(c, fabric="other") for c in curves if c.loading == 1]
    answer = diagnose_curves(model(), curves, once)
    row = answer.fabrics["other"]
    assert row["own numbers"] == {} and row["their numbers"]["loadings"] == 2
    assert not any("numbers from one repeat" in sentence for sentence in answer.sentences)
    write(answer, tmp_path)
    assert any("no other loading" in page.read_text() for page in tmp_path.glob("*.html"))


@pytest.mark.parametrize("further", [1.0, 1.3])
def test_loadings_that_are_pulled_further_each_time_do_not_drift(further):
    """Their mean force rises under the same law."""
    tops, grid = TOP * further ** np.arange(-3, 1), np.linspace(0, TOP, 24)
    repeats = 1 + 0.01 * np.array([[0.0], [1.0], [-1.0], [0.5]])
    force = np.where(grid <= tops[:, None] + 1e-12, 300.0 * repeats * (grid + 1e-3), np.nan)
    assert drift({"a": _bench(force)}) is None
    assert drift({"a": _bench(force * 1.1 ** np.arange(4)[:, None])}) == pytest.approx(0.1, abs=0.01)


def _bench(forces):
    """A fit as far as a drift looks at it."""
    loadings = [SimpleNamespace(force=f, curve=SimpleNamespace(loading=i + 1)) for i, f in enumerate(forces)]
    return SimpleNamespace(bench=SimpleNamespace(tests=[SimpleNamespace(loadings=loadings)]))


def test_an_effect_that_is_asked_for_twice_is_added_once():
    curves = measured(isotropic(fourth=1500.0), TOP, 1)
    one, two = (refit_curves(model(), curves, add=["strain_stiffening"] * many) for many in (1, 2))
    assert two.kept == ("strain_stiffening",) and two.outcome.coefficients == one.outcome.coefficients


def test_a_refit_refuses_what_does_not_help():
    curves = measured(isotropic(fourth=1500.0), TOP, 1)
    answer = refit_curves(model(), curves, add=["strain_stiffening", "hysteresis", "softening"])
    assert answer.kept == ("strain_stiffening",) and set(answer.refused) == {"hysteresis", "softening"}
    refitted = answer.models["cloth"][1]
    assert float(refitted.effects["strain_stiffening"]["stiffness"]) == pytest.approx(1500, rel=0.1)


@pytest.mark.parametrize("name", ["shrinkage", "air_drag_normal", "viscous_damping", "shear_stiffness"])
def test_what_the_tests_cannot_show_is_not_fitted_to_them(name):
    with pytest.raises(CaphyError, match=name):
        refit_curves(model(), measured(isotropic(), TOP), add=[name])


def bad(**changes: object) -> list[ForceCurve]:
    return [
        ForceCurve(c.fabric, c.direction, c.loading, *(changes[k](getattr(c, k)) if k in changes else getattr(c, k)
                   for k in ("axial", "transverse", "force")))
        for c in measured(isotropic(), TOP)
    ]  # fmt: skip


def shuffled(column: np.ndarray) -> np.ndarray:
    return column[np.random.default_rng(0).permutation(len(column))]


def turned(column: np.ndarray) -> np.ndarray:
    return column[::-1].copy()


@pytest.mark.parametrize(
    ("curves", "message"),
    [
        ([], "no force curves"),
        (bad(force=lambda f: -f), "positive in tension"),
        (bad(force=lambda f: 1e6 * f), "per metre of width"),
        (bad(force=lambda f: f / 1e3), "kN/m times 1000"),
        (bad(axial=turned, transverse=turned, force=turned), "Sort them by rising strain"),
        (bad(axial=shuffled, force=shuffled), "shuffled"),
        (bad(force=shuffled), "rank correlation"),
        (bad(force=lambda f: f + 20), "begins under load"),
        (measured(isotropic(), TOP, loadings=1), "repeats"),
        (measured(isotropic(), TOP) + measured(isotropic(), TOP), "two loadings are called"),
        (measured(isotropic(), TOP, law=lambda e, f, n: f * n**3), "nothing in common"),
    ],
)
def test_bad_input_is_refused_in_words(curves, message):
    with pytest.raises(CaphyError, match=message):
        diagnose_curves(model(), curves)


def test_what_may_be_percent_is_said(tmp_path, capsys):
    """Up to 3 knits reach it."""
    kept, cautions = usable(bad(axial=lambda strain: 2.5 / TOP * strain))
    assert len(kept) == 10
    (caution,) = cautions
    assert caution == "cloth weft 1: the largest strain read is 250 %; if the column is in percent, divide it by 100."
    assert not usable(measured(isotropic(), TOP))[1]
    table = tmp_path / "table.csv"
    table.write_text("axial_strain,force_per_width_N_per_m\n0,0\n1,50\n2,100\n2.5,125\n")
    assert main(["compare", "snug", str(table), "-o", str(tmp_path / "out")]) == 0
    assert f"Note: {table}: table weft 1: the largest strain read is 250 %" in capsys.readouterr().out


def let_go(curve: ForceCurve) -> ForceCurve:
    """The same, and back to no load by a softer way."""
    back = [each[-2::-1] for each in (curve.axial, curve.transverse, 0.8 * curve.force)]
    there = [np.concatenate(pair) for pair in zip((curve.axial, curve.transverse, curve.force), back, strict=True)]
    return ForceCurve(curve.fabric, curve.direction, curve.loading, *there)


def test_unloading_is_left_out_and_that_is_said():
    curves = measured(isotropic(), TOP)
    answer = diagnose_curves(model(), [let_go(curves[0]), *curves[1:]])
    assert answer.verdict == "nothing"
    assert any(f"1 of {len(curves)} loadings: rows of unloading are left out" in said for said in answer.cautions)


def test_a_comparison_leaves_unloading_out_too(tmp_path, capsys):
    """Forces on the way back are lower at the same strain, for which the model is not to blame; rows may run down."""
    table, errors = tmp_path / "strips.csv", []
    for change in (lambda curve: curve, let_go, lambda c: replace(c, **{k: turned(getattr(c, k)) for k in COLUMNS})):
        rows = [
            f"{c.direction},{c.loading},{a},{f}"
            for c in map(change, measured(isotropic(), TOP))
            for a, f in zip(c.axial, c.force, strict=True)
        ]
        table.write_text("\n".join(["direction,loading,axial_strain,force_per_width_N_per_m", *rows]))
        assert main(["compare", "snug", str(table), "-o", str(tmp_path / "out")]) == 0
        errors.append([c["rms_n_per_m"] for c in _written(tmp_path / "out")["force_curves"][0]["curves"]])
        assert ("rows of unloading are left out" in capsys.readouterr().out) == (change is let_go)
    np.testing.assert_allclose(errors[1:], errors[:1] * 2, rtol=1e-6)


COLUMNS = ("axial", "transverse", "force")


def _written(folder):
    return json.loads((folder / "compare.json").read_text())


def test_a_rise_of_too_few_rows_is_no_loading():
    curves = measured(isotropic(), TOP)
    short = let_go(ForceCurve("cloth", "weft", 1, *(getattr(curves[0], name)[::20] for name in COLUMNS)))
    with pytest.raises(CaphyError, match="at least 8 rows up to its largest strain, got 6"):
        diagnose_curves(model(), [short, *curves[1:]])


def test_what_is_pulled_farther_than_most_is_said_to_be_left_out():
    curves = measured(isotropic(), TOP)
    farther = measured(isotropic(), 2 * TOP, seed=1)[0]
    _, cautions = prepared([replace(farther, loading=6), *curves])
    assert [said for said in cautions if "cloth weft 6 goes beyond the strain of" in said]
    assert not prepared(curves)[1]


def test_a_loading_that_shares_no_strain_with_its_repeats_has_no_floor():
    """Of hand-typed tables of few rows; the error between repeats was NaN, and nothing was written."""
    test = prepared(measured(isotropic(), TOP, loadings=3))[0]["cloth"][0]
    every = np.arange(len(test.loadings[1].force))
    apart = [replace(r, force=np.where(every % 2 == k, 1.0, np.nan)) for k, r in enumerate(test.loadings[1:])]
    alone = replace(test, loadings=tuple(apart))
    assert _floor(alone, apart[0], [alone], own=True) is None
    assert _floor(test, test.loadings[1], [test], own=True) > 0


def test_fabrics_of_like_names_have_files_of_their_own():
    slugs = _slugs(["Jersey A", "jersey_a", "diagnosis", "refit", "x", "x_first"])
    assert slugs["Jersey A"] == "jersey_a" and len({*slugs.values()}) == 6
    files = [f"{slug}{end}" for slug in slugs.values() for end in ("", "_first")]
    assert len({*files}) == len(files) and not {"diagnosis", "refit"} & {*files}


def test_effects_that_leave_nothing_outside_the_scatter_explain_it(monkeypatch):
    """Where parameters alone nearly do, what is left of what they leave is a large share, and means nothing."""
    fits = dict.fromkeys(("as given", "parameters", "with effects"))
    for outside_at_the_end, verdict in ((False, "named"), (True, "none of these")):
        off = {"as given": True, "parameters": True, "with effects": outside_at_the_end}
        monkeypatch.setattr("caphy.tensile.diagnosis.outside", off.__getitem__)
        assert _verdict({stage: {"cloth": stage} for stage in fits}, ["hysteresis"], 0.9) == verdict


def test_a_refit_that_changes_nothing_says_so(tmp_path, capsys):
    table = tmp_path / "strips.csv"
    rows = [
        f"{c.direction},{c.loading},{a},{f}"
        for c in measured(isotropic(), TOP)
        for a, f in zip(c.axial, c.force, strict=True)
    ]
    table.write_text("\n".join(["direction,loading,axial_strain,force_per_width_N_per_m", *rows]))
    (tmp_path / "m.json").write_text(model().to_json())
    asked = ["refit", str(tmp_path / "m.json"), str(table), "--add", "strain_stiffening", "-o", str(tmp_path / "out")]
    assert main(asked) == 1
    assert "no effect; nothing was changed" in capsys.readouterr().out
    assert Model.load(tmp_path / "out" / "strips.json").history == model().history


def test_too_few_loadings_for_what_the_first_one_does_are_told():
    """Sixteen ways of exchanging the first of four loadings in two directions: one of them is one of twenty's."""
    few, enough = (diagnose_curves(model(), measured(isotropic(), TOP, loadings=count)) for count in (4, 5))
    assert TOO_FEW in few.cautions and TOO_FEW not in enough.cautions


@pytest.mark.parametrize(("factor", "message"), [(-1.0, "positive in tension"), (1e6, "per metre of width")])
def test_a_comparison_refuses_forces_of_other_signs_and_units(tmp_path, capsys, factor, message):
    """In words, and no curve is drawn of them."""
    table = tmp_path / "strips.csv"
    (first, *_) = measured(isotropic(), TOP)
    rows = [f"{a},{t},{factor * f}" for a, t, f in zip(first.axial, first.transverse, first.force, strict=True)]
    table.write_text("\n".join(["axial_strain,transverse_strain,force_per_width_N_per_m", *rows]))
    assert main(["compare", "snug", str(table), "-o", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_model_without_elasticity_is_refused():
    with pytest.raises(CaphyError, match="resists stretch"):
        diagnose_curves(Model(0.2, {"gravity": {}}), measured(isotropic(), TOP))


def test_results_are_written(tmp_path):
    answer = diagnose_curves(model(), measured(isotropic(fourth=1500.0), TOP, 1))
    paths = write(answer, tmp_path, since=model(), data=["strips"])
    assert {path.name for path in paths} == {"diagnosis.json", "diagnosis.html", "cloth.json"}
    document = json.loads((tmp_path / "diagnosis.json").read_text())
    assert document["verdict"] == "named" and document["found"] == [{"effect": "strain_stiffening", "from_loading": 1}]
    found = Model.load(tmp_path / "cloth.json")
    assert found.effects.keys() >= {"strain_stvk", "strain_stiffening"}
    assert (found.history[-1].added, found.history[-1].data) == (("strain_stiffening",), ("strips",))
    page = (tmp_path / "diagnosis.html").read_text()
    assert page.count("<svg") == 2 and "http" not in page.replace("http://www.w3.org", "")


OWN = '''
"""Stiffening along the threads."""
from caphy.effects.base import Parameter
from caphy.effects.membrane import Membrane


class ThreadStiffening(Membrane):
    """E = A / 4 (q_u G_uu^4 + q_v G_vv^4) [J]."""

    name = "thread_stiffening"
    group = "stiffness"
    parameters = {
        "weft": Parameter(100.0, "N/m", 0.0, 1e8, doc="along the weft"),
        "warp": Parameter(100.0, "N/m", 0.0, 1e8, doc="along the warp"),
    }
    reference = "made for a test of caphy"

    def density(self, strain, e, p):
        uu, vv, _ = strain
        return 0.25 * (p["weft"] * uu**4 + p["warp"] * vv**4)
'''


def test_an_effect_of_the_users_own_takes_part(tmp_path):
    from caphy.tensile.candidates import candidates

    path = tmp_path / "thread_stiffening.py"
    path.write_text(OWN)
    registry.register_file(path)
    try:
        assert "thread_stiffening" in candidates(model()).added
    finally:
        registry._from_files.pop("thread_stiffening")


def test_real_knits(shared_data):
    """One of the four knits, with half of its loadings, to be quick; docs/knit.md has all of them."""
    curves = read_force_curves(shared_data / "fabric_tests" / "knit_uniaxial.csv")
    some = [c for c in curves if c.fabric == "Acrylic_Yarn_Stockinette"]
    answer = diagnose_curves(model(), some)
    assert "weft_warp_stiffness" in answer.found
    share = answer.summary["relative"]
    assert share["with effects"] < 0.5 * share["parameters"] < 0.5 * share["as given"]
    assert answer.summary["floor_relative"] < 0.1
    assert not answer.complete and "none of the known effects" in " ".join(answer.sentences).lower()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"force": lambda force: 0 * force}, "its force is zero throughout"),
        ({"axial": lambda axial: 1 + axial}, "must start near 0"),
    ],
)
def test_tables_of_something_else_are_told(changes, message):
    with pytest.raises(CaphyError, match=message):
        bad(**changes)


HEADER = "fabric,direction,loading,axial_strain,transverse_strain,force_per_width_N_per_m"
ROWS = "\n".join(f"rib,weft,{{0}},{strain:.2f},nan,{20 * strain:.2f}" for strain in (0.0, 0.05, 0.1, 0.15))


def test_a_table_that_excel_wrote_is_read_as_any_other(tmp_path):
    table = tmp_path / "table.csv"
    table.write_text("\n".join([HEADER, ROWS.format("1"), ROWS.format("2.0")]), encoding="utf-8-sig")
    assert [(c.fabric, c.loading) for c in read_force_curves(table)] == [("rib", 1), ("rib", 2)]


def test_empty_rows_of_spreadsheets_are_passed_over_and_lines_counted(tmp_path):
    table = tmp_path / "table.csv"
    table.write_text("\n".join([HEADER, "", ROWS.format("1"), ",,,,,", ROWS.format("2"), ",,,,,", ""]))
    assert [(c.loading, len(c.axial)) for c in read_force_curves(table)] == [(1, 4), (2, 4)]
    table.write_text("\n".join([HEADER, "", ",,,,,", ROWS.format("x")]))
    with pytest.raises(CaphyError, match=r"table.csv: line 4: loading must be 1 .* got 'x'"):
        read_force_curves(table)


@pytest.mark.parametrize("loading", ["0", "L1", "1.5", "nan", "inf"])
def test_what_is_no_number_of_a_loading_is_told(tmp_path, loading):
    table = tmp_path / "table.csv"
    table.write_text("\n".join([HEADER, ROWS.format("1"), ROWS.format(loading)]))
    with pytest.raises(CaphyError, match=rf"table.csv: line 6: loading must be 1 .* got '{loading}'"):
        read_force_curves(table)


@pytest.mark.parametrize(
    "text",
    [
        "# my test\n" + HEADER + "\n" + ROWS.format(1),
        (HEADER + "\n" + ROWS.format(1)).replace(",", ";").replace(".", ","),
        (HEADER + "\n" + ROWS.format(1)).replace(",", "\t"),
    ],
)
def test_tables_parted_otherwise_are_told_how(tmp_path, text):
    table = tmp_path / "table.csv"
    table.write_text(text)
    with pytest.raises(CaphyError, match="the first line names them; commas part columns, points decimals"):
        read_force_curves(table)


def test_tables_have_no_base(tmp_path, capsys):
    table = tmp_path / "table.csv"
    table.write_text(HEADER + "\n" + ROWS.format(1))
    for words in (["diagnose", "snug"], ["refit", "snug"]):
        assert main([*words, str(table), "--base", str(table), "-o", str(tmp_path / "out")]) == 2
        assert "have no --base" in capsys.readouterr().err


def test_a_refit_of_tables_asks_for_a_folder(tmp_path, capsys):
    table = tmp_path / "table.csv"
    table.write_text(HEADER + "\n" + ROWS.format(1))
    assert main(["refit", "snug", str(table), "-o", str(tmp_path / "better.json")]) == 2
    assert "give a folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["table.csv"]


def test_used_cloth_remembers_its_first_loading():
    """The largest energy is that of the first loading; the loadings after it are softer already."""
    curves = measured(isotropic(), TOP, 0, scatter=0.0, law=softened(0.3))
    for test in prepared(curves)[0]["cloth"]:
        first = next(c for c in curves if c.direction == test.direction and c.loading == 1)
        assert test.reached == pytest.approx(np.trapezoid(first.force, first.axial), rel=0.01)
    answer = diagnose_curves(model(), measured(isotropic(), TOP, 0, scatter=0.01, law=softened(0.3)))
    assert (answer.found, answer.found_used) == ((), ("softening",))
    low, high = number(answer, "softening.share").interval
    assert low <= 0.3 <= high


def test_the_row_at_the_largest_strain_counts():
    strain, ways = np.linspace(0, 0.3, 10), ("weft", "warp")
    force = 100 * strain
    force[-1] = 90.0
    curves = [ForceCurve("cloth", way, k, strain, np.full(10, np.nan), force) for way in ways for k in (1, 2)]
    (weft, _) = prepared(curves)[0]["cloth"]
    assert weft.loadings[0].force[-1] == 90.0 and weft.loadings[0].strain[-1] == 0.3


def test_a_comparison_says_that_it_leaves_out_what_needs_motion(tmp_path, capsys):
    table = tmp_path / "strips.csv"
    table.write_text(HEADER + "\n" + ROWS.format(1))
    (tmp_path / "m.json").write_text(model().with_effect("hysteresis", friction=300.0).to_json())
    assert main(["compare", str(tmp_path / "m.json"), str(table), "-o", str(tmp_path / "out")]) == 0
    assert "as if each strain were held: hysteresis (caphy diagnose and caphy refit count" in capsys.readouterr().out


def test_a_diagnosis_of_tables_writes_over_no_model_that_it_read(tmp_path, capsys):
    """The user's model has the name that the fitted one would get."""
    mine = tmp_path / "cloth.json"
    mine.write_text(model().to_json())
    before = mine.read_bytes()
    write(diagnose_curves(model(), measured(isotropic(fourth=1500.0), TOP, 1)), tmp_path, read=[mine])
    assert mine.read_bytes() == before
    assert "strain_stiffening" in Model.load(tmp_path / "cloth_2.json").effects


def test_models_of_used_cloth_remember_and_those_of_an_earlier_answer_go(tmp_path):
    used = diagnose_curves(model(), measured(isotropic(), TOP, 0, scatter=0.01, law=softened(0.3)))
    assert tmp_path / "cloth_first.json" in write(used, tmp_path)
    reached = max(test.reached for test in used.fits["as given"]["cloth"].bench.tests)
    assert Model.load(tmp_path / "cloth.json").effects["softening"]["reach"] == pytest.approx(reached)
    write(diagnose_curves(model(), measured(isotropic(), TOP)), tmp_path)
    assert not (tmp_path / "cloth_first.json").exists()


RATIO = OWN.replace("ThreadStiffening", "Threads").replace("thread_stiffening", "threads").replace(
    '"warp": Parameter(100.0, "N/m", 0.0, 1e8, doc="along the warp"),',
    '"ratio": Parameter(0.5, "1", 0.0, 100.0, linear=False, doc="warp over weft"),',
).replace('    reference', '    further = {"ratio": (0.25, 1.0, 4.0)}\n    reference').replace(
    '0.25 * (p["weft"] * uu**4 + p["warp"] * vv**4)', '0.5 * p["weft"] * (uu**2 + p["ratio"] * vv**2)'
)  # fmt: skip


def test_numbers_that_an_effect_wants_fitted_too_are_fitted_to_tables(tmp_path, monkeypatch):
    """Threads of 20 N/m along the weft and three times as much along the warp."""
    monkeypatch.setattr(registry, "_from_files", {})
    path = tmp_path / "threads.py"
    path.write_text(RATIO)
    use_file(path)
    sheet = Sheet(LAMBDA + 2 * MU + 20, LAMBDA + 2 * MU + 60, LAMBDA)
    answer = refit_curves(model(), measured(sheet, TOP, scatter=0.01), add=["threads"])
    assert answer.kept == ("threads",)
    told = {c.name: c for c in answer.outcome.coefficients}
    added = told["threads.weft"].value
    assert told["threads.ratio"].value * added - added == pytest.approx(40, rel=0.1)  # mu may take what both share


@pytest.mark.parametrize(("unit", "factor"), [("N/m", 3.0), ("J/m^2", 3.0), ("kg/s^2", 3.0), ("N", 1.0), ("1", 1.0)])
def test_what_is_a_stiffness_scales_with_it_whatever_its_unit_is_called(unit, factor):
    np.testing.assert_array_equal(_scaled(np.array([2.0, -1.0]), unit, 3.0), factor * np.array([2.0, -1.0]))


def test_what_is_held_out_does_not_tell_how_much_repeats_scatter():
    """Nor how far they are pulled: a fourth loading, much stiffer and farther, leaves the others' bins as they are."""
    curves = [curve for curve in measured(isotropic(), TOP, loadings=3) if curve.direction == "weft"]
    odd = replace(curves[0], loading=4, axial=1.2 * curves[0].axial, force=1.5 * curves[0].force)
    (alone,), (beside,) = prepared(curves)[0]["cloth"], prepared(curves, [odd])[0]["cloth"]
    np.testing.assert_array_equal(beside.axial, alone.axial)
    np.testing.assert_array_equal(beside.scatter, alone.scatter)
    assert [loading.curve.loading for loading in beside.loadings] == [1, 2, 3, 4]


def test_a_loading_that_ends_before_the_others_are_looked_at_is_left_out():
    """Held out, it would be judged by nothing."""
    sheet, strain = Sheet(2000.0, 2000.0, 500.0), np.linspace(0, TOP / 120, 40)
    curves, (force, narrow) = measured(sheet, TOP, loadings=3), sheet.curve(strain, "weft")
    short = ForceCurve("cloth", "weft", 4, strain, narrow, force)
    fabrics, cautions = prepared(curves, [short])
    assert [len(test.loadings) for test in fabrics["cloth"]] == [3, 3]
    assert any("weft 4 ends before a strain of 0.25 %" in caution for caution in cautions)
