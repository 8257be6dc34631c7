"""Fitting a fabric to scans of a hanging panel whose fabric is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks._panel import Stills, panel, turns
from caphy.commands.fabric import _again
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.presets import fabric_model
from caphy.effects.strain_measured import energy_density
from caphy.errors import CaphyError
from caphy.fabric.bounded import FASTEST, Pooled, bounds, solve
from caphy.fabric.certainty import Certainty
from caphy.fabric.coefficients import Coefficients
from caphy.fabric.evidence import CONTACT, Said, by_force, by_response
from caphy.fabric.record import NOT_DETERMINED, record, settled_model
from caphy.fabric.rounds import Fitted, Round, _Scans, fit_fabric, over_first, ratios
from caphy.fabric.states import WEAK, Layer
from caphy.fabric.stills import Worn
from caphy.garment.subdivision import Subdivision
from caphy.kept import Kept
from caphy.solve.newton import Newton

SIDE = 7
PLANTED = fabric_model("white-swim-solid")


@pytest.fixture(scope="module")
def stills():
    return Stills(PLANTED, SIDE, turns(4, 3), 3)


@pytest.fixture(scope="module")
def scans(stills):
    """Scans without noise, on the mesh of the truth."""
    return stills.scans(panel(SIDE), 0.0, spacing=0.012)


def test_the_gradient_is_linear_in_the_tables():
    """Twice any two numbers' changes change the gradient twice as much, by what the columns say; of a fabric whose
    stiffness is nowhere near zero, through which others are led without slope."""
    random = np.random.default_rng(0)
    garment = panel(5)
    cloth, numbers = Cloth.of(garment, 0.2), Coefficients.of(fabric_model("11oz-black-denim"))
    x = torch.from_numpy(garment.vertices * 1.05 + 0.003 * random.normal(size=garment.vertices.shape))
    columns = numbers.forces(Potential(numbers.model(numbers.values), cloth), x, None)
    change = 0.02 * numbers.values * random.normal(size=len(numbers.values))

    def gradient(values):
        return Potential(numbers.model(values), cloth).gradient(x)[1]

    here = gradient(numbers.values)
    expected = torch.einsum("k,kvc->vc", torch.from_numpy(change), columns)
    for times in (1.0, 2.0):
        moved = gradient(numbers.values + times * change) - here
        np.testing.assert_allclose(moved, times * expected, atol=1e-4 * float(moved.abs().max()))


def test_energies_are_those_of_the_effects():
    numbers = Coefficients.of(PLANTED)
    garment = panel(5)
    potential = Potential(numbers.model(numbers.values), Cloth.of(garment, 0.2))
    x = torch.from_numpy(garment.vertices + 0.004 * np.random.default_rng(1).normal(size=garment.vertices.shape))
    energy = numbers.energies(potential, x)
    for name, total in potential.energies(x).items():
        if name in numbers.names:
            mine = numbers.group == numbers.names.index(name)
            assert energy[mine] @ numbers.values[mine] == pytest.approx(float(total), rel=1e-6)


def test_a_fit_that_is_stopped_goes_on_where_it_was(scans, tmp_path, monkeypatch):
    """A mesh's correction included; where cloth comes to rest is not sought a second time."""
    kept, sought = Kept(tmp_path), []
    minimise = Newton.minimise
    monkeypatch.setattr(Newton, "minimise", lambda *of, **more: sought.append(1) or minimise(*of, **more))

    def fit(kept: Kept | None, last: tuple[int, int] = (9, 9)) -> tuple[Fitted, int]:
        def stop(number: int, done: int, total: int) -> None:
            if (number, done) > last:
                raise KeyboardInterrupt

        sought.clear()
        found = fit_fabric(scans[:5], PLANTED, rounds=3, progress=stop, corrections=1, kept=kept)
        return found, len(sought)

    whole, cost = fit(None)
    with pytest.raises(KeyboardInterrupt):
        fit(kept, (1, 2))
    assert any(one.corrected for one in whole.rounds)
    again, rest = fit(kept)
    np.testing.assert_array_equal(again.values, whole.values)
    assert 0 < rest < 0.7 * cost
    once_more, none = fit(kept)
    np.testing.assert_array_equal(once_more.values, whole.values)
    assert none == 0


def test_the_response_is_the_change_of_the_equilibrium(scans):
    """Against the solver: the same hits, numbers changed a little, brought to rest again."""
    numbers = Coefficients.of(PLANTED)
    cloth = Cloth.of(scans[0].garment, PLANTED.density)
    layer = Layer(PLANTED, cloth)
    layer.newton = layer.newton.within(1e-8)
    lying = layer.lie(scans[0], scans[0].skinned(), seek=True)
    x, _ = layer.newton.minimise(torch.from_numpy(lying.x), None, scans[0].seen)  # with the very hits that are told
    lying = replace(lying, x=x.numpy())
    said = by_response(layer, scans[0], lying, numbers)
    change = np.concatenate([0.02 * numbers.values, np.zeros(len(CONTACT))])
    other = Layer(numbers.model(1.02 * numbers.values), cloth)
    other.potential.aim(lying.hits, WEAK)
    after, report = other.newton.within(1e-8).minimise(x, None, scans[0].seen)
    assert report.converged
    moved = lying.hits.residual(lying.x) - lying.hits.residual(after.numpy())
    near = np.abs(lying.hits.residual(lying.x)) < 0.012
    assert change @ said.a @ change == pytest.approx(float((moved[near] ** 2).sum()), rel=0.1)


def test_rounds_of_fits_in_turns_are_told_over_the_first_start(monkeypatch):
    """The later fit began with twice the start's stiffness; what is drawn again begins where it began."""
    first = Coefficients.of(PLANTED)
    later = Coefficients.of(first.model(2 * first.values), PLANTED)
    count = len(first.values) + len(CONTACT)
    stored = np.ones(len(first.values)), _sums(first, first.values)
    said = 3 * (Said(np.eye(count), np.zeros(count), 1.0, 9, *stored, 0.001),)

    def fitted(numbers: Coefficients, *times: float) -> Fitted:
        values = [share * numbers.values for share in times]
        told = [over_first(numbers, said, each) for each in values]
        rounds = tuple(Round(*each, 0.001) for each in zip(values, [said] * len(times), told, strict=True))
        return Fitted(numbers, values[-1], rounds)

    both = _again(fitted(first, 1.0, 2.0), fitted(later, 1.0, 1.5))
    for name in first.names:
        assert [one.stiffness[name] for one in both.rounds] == pytest.approx([1, 2, 2, 3])
        assert both.stiffness[name] == pytest.approx(3)
    begun = []
    monkeypatch.setattr("caphy.fabric.certainty.solve", lambda pooled, numbers, values: begun.append(numbers) or values)
    sure = Certainty.of(both)
    assert all(np.array_equal(numbers.values, later.values) for numbers in begun)
    assert sure.low == pytest.approx(dict.fromkeys(first.names, 3.0))


@pytest.mark.parametrize("evidence", ["response", "force"])
def test_stiffness_is_told_over_the_start_s_own_tables(scans, evidence):
    """Gray interlock has entries below zero, raised where a fit begins: what is fitted is not the fabric."""
    start = fabric_model("gray-interlock")
    numbers, cloth = Coefficients.of(start), Cloth.of(scans[0].garment, start.density)
    layer = Layer(numbers.model(numbers.values), cloth)
    lying = layer.lie(scans[0], scans[0].skinned(), seek=True)
    if evidence == "response":
        said, x = by_response(layer, scans[0], lying, numbers), torch.from_numpy(lying.x)
    else:
        said, x = by_force(layer, scans[0], lying, numbers, numbers.values), torch.from_numpy(lying.drawn)
    fitted = Fitted(numbers, 2 * numbers.values, (Round(numbers.values, (said,), {}, 1e-3),))
    own, raised = (Potential(one, cloth).energies(x) for one in (start, numbers.model(numbers.values)))
    assert raised["strain_measured"] < 0.9 * own["strain_measured"]
    for name in numbers.names:
        assert fitted.stiffness[name] == pytest.approx(2 * float(raised[name] / own[name]), rel=1e-5)
    middle = fitted.stiffness["strain_measured"]
    sure = Certainty.of(fitted)
    assert sure.low["strain_measured"] <= middle <= sure.high["strain_measured"]
    document = record(fitted, sure, settled_model(fitted, sure), "response")
    told = {row["name"]: row["start"] for row in document["numbers"]}
    assert told["strain_measured.stretching[4,3]"] == start.effects["strain_measured"]["stretching"][4][3] < 0


def test_stiffness_of_a_later_fit_is_told_over_the_first_model(scans):
    later = Coefficients.of(PLANTED)
    fitted = fit_fabric(scans, later.model(2 * later.values), rounds=1, corrections=0, first=PLANTED)
    told = fitted.rounds[0].stiffness
    assert told == pytest.approx(dict.fromkeys(later.names, 2.0), rel=0.03)  # four entries are raised


def test_a_planted_fabric_is_found_from_a_wrong_one(scans):
    """No noise and the mesh of the truth: both tables' stiffness within 10 %, from half and from twice of it."""
    numbers = Coefficients.of(PLANTED)
    factor = np.where(numbers.group == 0, 0.5, 2.0)
    fitted = fit_fabric(scans, numbers.model(factor * numbers.values), rounds=5, corrections=0)
    found = ratios(fitted.numbers, fitted.energy, fitted.values, numbers.values)
    assert found == pytest.approx({"strain_measured": 1.0, "bending_measured": 1.0}, abs=0.1)
    sure = Certainty.of(fitted)
    assert all(sure.determined.values())
    document = record(fitted, sure, settled_model(fitted, sure), "response")
    low, high = document["stiffness"]["strain_measured"]["interval"]
    assert low < document["stiffness"]["strain_measured"]["over_the_start"] < high
    changed = document["model"]["history"][-1]["parameters"]
    assert set(changed) == {"strain_measured.stretching", "bending_measured.bending"}


def test_density_scales_the_stiffness_found(scans):
    """At rest only ratios to the density are told: twice the weight, twice the stiffness, in the same cloth."""
    layer = [Layer(replace(PLANTED, density=d * PLANTED.density), Cloth.of(panel(SIDE), 0.2)) for d in (1.0, 2.0)]
    numbers = [Coefficients.of(one.potential.model) for one in layer]
    doubled = numbers[1].model(2 * numbers[1].values)
    flat = scans[0].skinned()
    x = torch.from_numpy(flat + 0.01 * np.random.default_rng(2).normal(size=flat.shape))
    heavy = Potential(doubled, layer[1].cloth).term_gradients(x)
    light = Potential(numbers[0].model(numbers[0].values), layer[0].cloth).term_gradients(x)
    for name in (*numbers[0].names, "gravity"):
        np.testing.assert_allclose(heavy[name], 2 * light[name], rtol=1e-9, atol=1e-12)


def test_without_noise_both_objectives_keep_the_true_fabric(scans):
    """The forces of what was drawn to the points balance: a residual would count as the fabric's."""
    numbers = Coefficients.of(PLANTED)
    layer = Layer(numbers.model(numbers.values), Cloth.of(panel(SIDE), PLANTED.density))
    lying = [layer.lie(one, one.skinned(), seek=True) for one in scans]
    response = [by_response(layer, *each, numbers) for each in zip(scans, lying, strict=True)]
    force = [by_force(layer, *each, numbers, numbers.values) for each in zip(scans, lying, strict=True)]
    for said in (response, force):
        values = solve(Pooled.of(said), numbers, numbers.values)
        found = ratios(numbers, said[0].energy, values, numbers.values)
        assert found == pytest.approx({"strain_measured": 1.0, "bending_measured": 1.0}, abs=0.1)


def test_noise_biases_the_squared_gradient_and_hardly_the_response():
    """From the true fabric, on the truth's own mesh: CaPhy's objective on noisy scans makes cloth limp."""
    noisy = Stills(PLANTED, SIDE, turns(8, 3), 3).scans(panel(SIDE), 0.002, spacing=0.012)
    found = {}
    for objective in ("response", "force"):
        fitted = fit_fabric(noisy, PLANTED, rounds=4, objective=objective, corrections=0)
        found[objective] = fitted.stiffness["bending_measured"]
    assert 0.75 < found["response"] < 1.25
    assert found["force"] < 0.2


def test_a_mesh_of_quarters_is_the_same_cloth():
    coarse = panel(5)
    finer = Subdivision.of(coarse)
    before, after = (Cloth.of(one, 0.2) for one in (coarse, finer.garment))
    assert len(after.faces) == 4 * len(before.faces)
    assert len(after.vertices) == len(before.vertices) + len(before.edges)
    np.testing.assert_allclose(after.face_area.reshape(-1, 4), np.repeat(before.face_area[:, None] / 4, 4, 1))
    np.testing.assert_array_equal(finer.garment.vertices[: len(coarse.vertices)], coarse.vertices)
    assert after.attached.sum() == 2 * before.attached.sum() - 2  # both bars, and nothing between them
    bent = coarse.vertices + np.array([0, 0.1, 0]) * np.cos(8 * coarse.vertices[:, :1])
    elastic = Model(0.2, {name: PLANTED.effects[name] for name in ("strain_measured", "gravity")})
    fine, rough = (
        Potential(elastic, cloth).energies(torch.from_numpy(x))
        for cloth, x in ((after, finer.carried(bent)), (before, bent))
    )
    for name, energy in rough.items():
        assert float(fine[name]) == pytest.approx(float(energy), rel=1e-9, abs=1e-12)


def test_the_mesh_s_error_is_taken_off():
    """Scans of a finer mesh: at the true fabric a coarse one asks for another, and for less once it is corrected."""
    numbers = Coefficients.of(PLANTED)
    worn = Stills(PLANTED, 11, turns(3, 4), 4).scans(panel(6), 0.0, spacing=0.01)
    scans = _Scans(tuple(worn), numbers, "response", None, None)
    table = np.concatenate([np.where(numbers.group == 0, numbers.values, 0), np.zeros(len(CONTACT))])
    asked, misfit = [], []  # asked of the stretching; bending next to nothing here
    for _ in range(2):
        said = scans.look(numbers.values, 0)
        pooled = Pooled.of(said)
        asked.append(abs(table @ pooled.b / (table @ pooled.a @ table)))
        misfit.append([np.sqrt(one.c / one.count) for one in said])
        scans.correct(numbers.values)
    assert len(scans.mesh) == 3
    assert asked[1] < 0.5 * asked[0]
    assert (np.array(misfit[1]) < 0.5 * np.array(misfit[0])).all()


def _said(numbers: Coefficients, told: np.ndarray, wanted: np.ndarray, seed: int) -> Said:
    """A scan that wants numbers changed by ``wanted`` (K,), and feels only those ``told`` (K,)."""
    random = np.random.default_rng(seed)
    count = len(numbers.values)
    j = np.zeros((200, count + len(CONTACT)))
    j[:, :count] = np.where(told, random.normal(size=(200, count)) / numbers.values, 0)
    r = j[:, :count] @ wanted + 0.02 * random.normal(size=200)
    return Said(j.T @ j, j.T @ r, float(r @ r), 200, np.ones(count), _sums(numbers, numbers.values), 1e-3)


def _sums(numbers: Coefficients, values: np.ndarray) -> np.ndarray:
    """What tables of values (K,) store where each number is asked for one joule per unit (G,)."""
    return np.bincount(numbers.group, values)


def test_a_round_keeps_within_bounds():
    numbers = Coefficients.of(PLANTED)
    everywhere = np.ones(len(numbers.values), bool)
    for wanted in (-10.0, 10.0):
        said = [_said(numbers, everywhere, wanted * numbers.values, seed) for seed in range(6)]
        found = solve(Pooled.of(said), numbers, numbers.values)
        low, high = bounds(numbers, numbers.values)
        assert (found >= low - 1e-12).all() and (found <= high + 1e-12).all()
        assert (found > 0).all()
        total = found[numbers.group == 0].sum() / numbers.values[numbers.group == 0].sum()
        assert total == pytest.approx(FASTEST if wanted > 0 else 1 / FASTEST, rel=0.3)
    numbers.model(found)  # a valid model: the parameters' own bounds hold


@pytest.mark.parametrize("bearable", [0.4, 0.0])
def test_a_round_that_loses_the_cloth_is_taken_back(scans, monkeypatch, bearable):
    """Half-way back where cloth rests again, or to the round before, and then nothing is said to be determined."""
    numbers, looked, look = Coefficients.of(PLANTED), [], _Scans.look
    start = 0.5 * numbers.values

    def fragile(self, values, number):
        looked.append(abs(np.log(values[numbers.group == 0].sum() / start[numbers.group == 0].sum())))
        if number > 0 and looked[-1] > bearable:
            raise CaphyError("the cloth did not come to rest")
        return look(self, values, number)

    monkeypatch.setattr(_Scans, "look", fragile)
    fitted = fit_fabric(scans, numbers.model(start), rounds=2, corrections=0)
    assert looked[1] > 0.4 and looked[2] == pytest.approx(looked[1] / 2, rel=0.3)
    if bearable:
        assert len(fitted.rounds) == 2 and not fitted.left_out
    else:
        assert len(fitted.rounds) == 1 and np.array_equal(fitted.values, fitted.rounds[0].values)
        assert not any(Certainty.of(fitted).determined.values())


def test_what_fails_once_the_mesh_is_told_has_not_settled(scans, monkeypatch):
    """Rounds had, without the mesh's error, which no interval then knows."""
    look = _Scans.look

    def fails(self, values, number):
        if self.mesh:
            raise CaphyError("two scans are left")
        return look(self, values, number)

    monkeypatch.setattr(_Scans, "look", fails)
    monkeypatch.setattr(_Scans, "correct", lambda self, _: self.mesh.update({"a": np.zeros(3)}))
    monkeypatch.setattr("caphy.fabric.rounds.SETTLED", np.inf)
    fitted = fit_fabric(scans, PLANTED, rounds=3, corrections=1)
    assert [one.corrected for one in fitted.rounds] == [False]
    assert not fitted.settled and not any(Certainty.of(fitted).determined.values())


def test_no_stretch_of_the_fabric_found_yields_energy():
    """Scans that ask for a soft sheet with an unchanged coupling: each row's matrix stays positive definite."""
    numbers = Coefficients.of(fabric_model("gray-interlock"))
    everywhere = np.ones(len(numbers.values), bool)
    coupling = np.array([column.entry is not None and column.entry[-1] == 1 for column in numbers.columns])
    wanted = np.where(coupling, 0.3, -0.6) * numbers.values
    found = solve(
        Pooled.of([_said(numbers, everywhere, wanted, seed) for seed in range(6)]), numbers, numbers.values
    )  # fmt: skip
    table = found[numbers.group == 0].reshape(-1, 4)
    assert (table[:, 1] ** 2 < table[:, 0] * table[:, 2]).all()
    model = numbers.model(found)
    uu, vv = torch.meshgrid(torch.linspace(-0.1, 0.1, 21), torch.linspace(-0.1, 0.1, 21), indexing="ij")
    strain = (uu.double(), vv.double(), torch.zeros_like(uu).double())
    energy = energy_density(strain, torch.as_tensor(np.asarray(model.effects["strain_measured"]["stretching"])))
    assert energy[uu.abs() + vv.abs() > 0.01].min() > 0


def test_what_scans_do_not_tell_is_not_determined_and_keeps_the_start_s_table():
    numbers = Coefficients.of(PLANTED)
    stretch = numbers.group == 0
    said = tuple(_said(numbers, stretch, 0.2 * numbers.values, seed) for seed in range(8))
    values = solve(Pooled.of(said), numbers, numbers.values)
    history = (Round(numbers.values, said, {}, 1e-3),)
    fitted = Fitted(numbers, values, history)
    sure = Certainty.of(fitted)
    assert sure.determined == {"strain_measured": True, "bending_measured": False}
    model = settled_model(fitted, sure)
    np.testing.assert_array_equal(
        model.effects["bending_measured"]["bending"], PLANTED.effects["bending_measured"]["bending"]
    )
    document = record(fitted, sure, model, "response")
    assert document["model"]["history"][-1]["note"] == "strain_measured fitted to scans at rest"
    assert document["stiffness"]["bending_measured"]["over_the_start"] == NOT_DETERMINED
    told = {row["name"]: row["found"] for row in document["numbers"]}
    assert told["bending_measured.bending[0,0]"] == NOT_DETERMINED
    assert told["strain_measured.stretching[0,0]"] == pytest.approx(1.2 * numbers.values[0], rel=0.05)


@pytest.mark.parametrize(("before", "wide"), [(None, False), (1.19, False), (0.8, True)])
def test_what_the_mesh_moved_is_doubted(before, wide):
    """All scans share its error, so that their disagreement does not tell it."""
    numbers = Coefficients.of(PLANTED)
    said = tuple(_said(numbers, np.ones(len(numbers.values), bool), 0.2 * numbers.values, seed) for seed in range(8))
    values = solve(Pooled.of(said), numbers, numbers.values)
    history = (Round(numbers.values, said, dict.fromkeys(numbers.names, before), 1e-3, before is not None),)
    fitted = Fitted(numbers, values, history)
    sure = Certainty.of(fitted)
    for name in numbers.names:
        half = np.log(sure.high[name] / sure.low[name]) / 2
        moved = 0.0 if before is None else abs(np.log(fitted.stiffness[name] / before))
        assert half >= 2 / 3 * moved
        assert (half > 0.2) == wide


def test_scans_that_disagree_leave_a_table_undetermined():
    numbers = Coefficients.of(PLANTED)
    everywhere = np.ones(len(numbers.values), bool)
    said = tuple(
        _said(numbers, everywhere, sign * 3 * numbers.values, seed) for seed, sign in enumerate((1, -1, 1, -1, 1))
    )
    fitted = Fitted(numbers, numbers.values, (Round(numbers.values, said, {}, 1e-3),))
    assert not any(Certainty.of(fitted).determined.values())


def test_rounds_that_are_still_moving_determine_nothing():
    numbers = Coefficients.of(PLANTED)
    everywhere = np.ones(len(numbers.values), bool)
    said = tuple(_said(numbers, everywhere, 0.1 * numbers.values, seed) for seed in range(6))
    history = (Round(numbers.values, said, {}, 1e-3),)
    change = {"strain_measured": 1.02, "bending_measured": 1.3}
    sure = Certainty.of(Fitted(numbers, 1.1 * numbers.values, history, change=change))
    assert sure.determined == {"strain_measured": True, "bending_measured": False}


def test_a_scan_of_something_else_is_left_out_by_name(scans):
    stray = replace(scans[0].still, name="stray", points=scans[0].still.points + np.array([0.0, 0.0, 2.0]))
    worn = [Worn(stray, scans[0].body, scans[0].garment), *scans[:3]]
    fitted = fit_fabric(worn, PLANTED, rounds=1, corrections=0)
    assert list(fitted.left_out) == ["stray"] and "points lie within" in fitted.left_out["stray"]
    assert len(fitted.rounds[0].said) == 3
    with pytest.raises(CaphyError, match=r"at least 3 scans.*\n  stray"):
        fit_fabric(worn[:3], PLANTED, rounds=1, corrections=0)


def test_models_that_cannot_be_fitted_are_refused(scans):
    with pytest.raises(CaphyError, match="strain_measured"):
        fit_fabric(scans, Model(0.2, {"gravity": {}}))
    with pytest.raises(CaphyError, match="above zero"):
        fit_fabric(scans, PLANTED.with_effect("bending", stiffness_weft=0.0, stiffness_warp=0.0))
    with pytest.raises(CaphyError, match="stretches freely"):
        fit_fabric(scans, Model(0.2, {"bending": {"stiffness_weft": 1e-5, "stiffness_warp": 1e-5}}))
    with pytest.raises(CaphyError, match="at least 3 scans"):
        fit_fabric([], PLANTED)
