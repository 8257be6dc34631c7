"""Windows restarted from a measurement that an independent explicit integrator made."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from explicit_cloth import measured, normals, simulate

from caphy.commands import compare as command
from caphy.commands.compare import load_model, main
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement, write_measurement
from caphy.measure import prediction
from caphy.measure.comparison import compare
from caphy.measure.finer import FinerMesh
from caphy.measure.prediction import predict_in_windows
from caphy.measure.scene import Scene
from caphy.measure.windows import StartStates, filled, inertial_force, window_starts
from caphy.solve.integrators import ImplicitEuler, State
from caphy.solve.newton import Newton
from caphy.solve.rollout import Simulator

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})


@pytest.fixture(scope="module")
def truth() -> tuple[np.ndarray, dict]:
    return simulate()


@pytest.fixture(scope="module")
def plain(truth) -> Measurement:
    return measured(*truth)


@pytest.fixture(scope="module")
def dragged() -> Measurement:
    return measured(*simulate(drag=0.6))


def compared(measurement: Measurement) -> dict:
    scene = Scene.of(measurement)
    return compare(predict_in_windows(scene, MODEL), measurement).figures


@pytest.mark.parametrize(
    ("off", "part"),
    [
        (lambda change, other: 0.4 * change, 0.4),
        (lambda change, other: 3.0 * change, 1.0),
        (lambda change, other: -change, 0.0),
        (lambda change, other: other, 0.0),
    ],
    ids=["a part", "more", "the other way", "another way"],
)
def test_a_finer_step_explains_as_much_as_the_measurement_shows(plain, monkeypatch, off, part):
    """Where the model is off in another way than by its step, the step is not to blame, however far it moves cloth."""
    rolled, made = prediction.roll_out, []
    change = np.random.default_rng(0).normal(0, 0.02, (9, len(plain.rest_vertices), 3))
    other = np.random.default_rng(1).normal(0, 0.02, change.shape)
    other -= (other * change).sum() / (change**2).sum() * change

    def roll_out(scene, simulator, state, frame, *, length, substeps=prediction.SUBSTEPS):
        run = rolled(scene, simulator, state, frame, length=length)
        made.append(run.positions)
        moved = change if substeps > prediction.SUBSTEPS else 0.0
        return replace(run, positions=run.positions + moved)

    monkeypatch.setattr(prediction, "roll_out", roll_out)
    windows = prediction.Windows(Scene.of(plain), MODEL)
    frame = windows.frames[0]
    windows.told(frame)
    vertices = plain.vertices.copy()
    vertices[frame : frame + 9] = made[0] + off(change, other)
    monkeypatch.setattr(windows, "scene", replace(windows.scene, measurement=replace(plain, vertices=vertices)))
    told = windows.told(frame).step_error
    np.testing.assert_allclose(told, part * np.linalg.norm(change[1:], axis=-1), atol=1e-6)


def test_of_clouds_what_is_not_the_models_is_told_across_the_cloth(plain, monkeypatch):
    """As their points' distances are: what they are measured by, and what explains it, must be of one kind."""
    rolled, made = prediction.roll_out, []
    of_mesh = np.random.default_rng(0).normal(0, 0.02, (9, len(plain.rest_vertices), 3))

    def roll_out(*given, **more):
        made.append(rolled(*given, **more))
        return made[-1]

    monkeypatch.setattr(prediction, "roll_out", roll_out)
    monkeypatch.setattr(FinerMesh, "difference", lambda *_: of_mesh)
    scene = Scene.of(plain)
    windows = prediction.Windows(replace(scene, ends=np.full((len(plain), 1, 3), np.nan)), MODEL)
    frame = windows.frames[0]
    told = windows.told(frame)
    run, slow, truth, again = (each.positions for each in made)
    away = plain.vertices[frame : frame + 9] - run
    for found, change in ((told.step_error, slow - run), (told.mesh_error, of_mesh)):
        normal = normals(run, plain.faces)
        across = (change * normal).sum(-1)
        share = np.clip(((away * normal).sum(-1) * across).sum() / (across**2).sum(), 0, 1)
        np.testing.assert_allclose(found, share * np.abs(across)[1:], atol=1e-9)
    truth = truth[prediction.RUN_UP :]
    restarted = np.abs(((again - truth) * normals(truth, plain.faces)).sum(-1))
    np.testing.assert_allclose(told.start_error, restarted[1:], atol=1e-9)
    assert np.median(restarted) < 0.8 * np.median(np.linalg.norm(again - truth, axis=-1))


def test_restarts_see_no_more_than_the_measurement_does(plain, monkeypatch):
    """Holes of a model's own motion are where the measurement has them, whether NaN or told by a mask."""
    monkeypatch.setattr(FinerMesh, "difference", lambda self, simulator, state, run: np.zeros_like(run.positions))
    seen = np.random.default_rng(0).uniform(size=(len(plain), 1, 9, 1)) > 0.4
    seen = np.broadcast_to(seen, (len(plain), 9, 9, 1)).reshape(len(plain), 81)
    holes = replace(plain, vertices=np.where(seen[..., None], plain.vertices, np.nan))
    told = []
    for measurement in (holes, replace(plain, visibility=seen)):
        windows = prediction.Windows(Scene.of(measurement), MODEL)
        told.append(windows.told(windows.frames[0]).start_error)
    assert np.isfinite(told[1]).all()
    np.testing.assert_allclose(told[0], told[1], atol=1e-9)


def test_the_right_model_is_told_from_one_that_lacks_an_effect(plain, dragged):
    right, wrong = compared(plain), compared(dragged)
    assert right["floor"]["unexplained_mm"] < 1.5
    assert "the median does not tell" in right["sentences"][1]
    assert wrong["floor"]["unexplained_mm"] > 3
    assert not any("does not tell" in sentence for sentence in wrong["sentences"])
    assert wrong["by_lag"][-1]["median_mm"] > 3 * wrong["by_lag"][0]["median_mm"]
    assert right["prediction"]["converged"] == 1


def test_starts_are_nearer_to_the_truth_than_the_data_are(plain, truth):
    positions, _ = truth
    scene = Scene.of(plain)
    starts = StartStates(scene, scene.potential(MODEL))
    truth_velocity = (positions[2:] - positions[:-2]) * 15
    data = np.median(np.linalg.norm(plain.vertices - positions, axis=-1))
    raw = np.median(np.linalg.norm((plain.vertices[2:] - plain.vertices[:-2]) * 15 - truth_velocity, axis=-1))
    at = [starts.state(frame) for frame in (10, 25, 40)]
    place = [np.linalg.norm(s.x.numpy() - positions[f], axis=1) for s, f in zip(at, (10, 25, 40), strict=True)]
    speed = [np.linalg.norm(s.v.numpy() - truth_velocity[f - 1], axis=1) for s, f in zip(at, (10, 25, 40), strict=True)]
    assert np.median(place) < 0.8 * data
    assert np.median(speed) < 0.8 * raw


@pytest.mark.parametrize(("mass", "pull"), [("extra_mass", 1.0), ("added_mass", 0.5)])
def test_starts_feel_the_inertia_of_all_mass(plain, mass, pull):
    """As of cloth twice as dense; what has no weight as if gravity were half."""
    scene = Scene.of(plain)
    light = Model(0.2, {**MODEL.effects, mass: {"density": 0.2}})
    dense = Model(0.4, MODEL.effects).with_effect("gravity", acceleration=np.array([0, -9.81 * pull, 0]))
    one, other = (StartStates(scene, scene.potential(model)).positions(25) for model in (light, dense))
    np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize(
    "air",
    [{"wind_normal": {"coefficient": 1.2, "push": (0.0, 0.0, 2.4)}}, {"pressure": {"pressure": 1.0}}],
    ids=["wind", "pressure"],
)
def test_cloth_at_rest_in_the_air_starts_where_it_rests(plain, air):
    """Set to rest by steps so long that inertia is none of it."""
    model = Model(0.2, {**MODEL.effects, "bending": {}, **air})
    scene = Scene.of(plain)
    potential = scene.potential(model)
    assert scene.pins is not None and scene.fixed is not None
    x = torch.from_numpy(plain.vertices[0].copy())
    x[torch.from_numpy(np.flatnonzero(scene.fixed))] = scene.pins(0.0)
    state = State(0.0, x, torch.zeros_like(x))
    held = Simulator(Newton(potential, scene.fixed, 1e-8, 300), integrator=ImplicitEuler())
    for _ in range(300):
        state, _ = held.advance(state, 0.1)
    assert state.v.abs().max() < 1e-3
    still = replace(plain, vertices=np.repeat(state.x.numpy()[None], len(plain), axis=0))
    still = replace(still, pinned_positions=np.repeat(plain.pinned_positions[:1], len(plain), axis=0))
    starts = StartStates(Scene.of(still), potential)
    apart = np.linalg.norm(starts.positions(4) - state.x.numpy(), axis=1)
    assert np.median(apart) < 5e-5


def test_inertial_forces_are_mass_times_acceleration(plain):
    potential = Scene.of(plain).potential(Model(0.2, {**MODEL.effects, "heavy_hem": {}, "added_mass": {}}))
    acceleration = np.random.default_rng(0).normal(0, 20, potential.cloth.vertices.shape)
    rim = potential.cloth.vertex_area < 0.9 * potential.cloth.vertex_area.max()
    hem = np.where(rim, 0.004 * 0.6 / 8, 0.0)  # line density times the spacing of the vertices along the rim
    mass = 0.3 * potential.cloth.vertex_area + hem
    np.testing.assert_allclose(inertial_force(potential, acceleration), mass[:, None] * acceleration, rtol=1e-9)


def test_windows_avoid_holes_and_say_so_where_none_is_left(plain):
    vertices = plain.vertices.copy()
    vertices[14:22] = np.nan
    scene = Scene.of(replace(plain, vertices=vertices))
    starts = window_starts(StartStates(scene, scene.potential(MODEL)))
    assert len(starts) >= 5
    assert not set(starts) & set(range(15, 21))
    vertices = np.full_like(vertices, np.nan)
    vertices[::5] = plain.vertices[::5]
    scene = Scene.of(replace(plain, vertices=vertices))
    with pytest.raises(CaphyError, match="no window can start"):
        predict_in_windows(scene, MODEL)


def test_holes_are_filled_harmonically(plain):
    scene = Scene.of(plain)
    cloth = scene.potential(MODEL).cloth
    linear = cloth.vertices @ np.array([[1.0, 2, 0], [0, 1, 0], [3, 0, 1]]) + 0.3
    known = np.ones(81, bool)
    known[[40, 41, 49, 50]] = False
    np.testing.assert_allclose(filled(np.where(known[:, None], linear, np.nan), known, cloth), linear, atol=1e-6)


def test_scenes_that_cannot_be_simulated_are_told(plain):
    with pytest.raises(CaphyError, match="needs the cloth's rest_vertices"):
        Scene.of(replace(plain, rest_vertices=None, material=None))
    with pytest.raises(CaphyError, match="nothing holds the cloth"):
        Scene.of(replace(plain, pinned=None, pinned_positions=None))


def test_a_garment_whose_vertices_come_in_another_order_is_refused(plain):
    garment = Scene.of(plain).garment
    order = np.random.default_rng(0).permutation(len(garment.vertices))
    place = np.argsort(order).astype(np.int32)
    other = replace(
        garment, vertices=garment.vertices[order], faces=place[garment.faces], weights=garment.weights[order]
    )
    with pytest.raises(CaphyError, match="vertices must come in the garment's order"):
        Scene.of(plain, other)
    fewer = replace(garment, faces=garment.faces[1:], material=garment.material[1:])
    with pytest.raises(CaphyError, match="its faces are not those of garment"):
        Scene.of(plain, fewer)
    turned = replace(garment, faces=np.roll(garment.faces[::-1], 1, axis=1), material=garment.material[::-1])
    assert Scene.of(plain, turned).garment is turned
    points = {"vertices": None, "points": plain.vertices.reshape(-1, 3), "offsets": 81 * np.arange(len(plain) + 1)}
    bare = replace(plain, **points, faces=None, rest_vertices=None, material=None, pinned=None, pinned_positions=None)
    with pytest.raises(CaphyError, match="nothing holds the cloth"):  # no mesh that could be another
        Scene.of(bare, other)
    with pytest.raises(CaphyError, match="its faces are not those"):
        Scene.of(replace(plain, **points), other)


def test_the_command_writes_figures_and_one_page(plain, tmp_path, capsys, monkeypatch):
    """... and a run that was stopped is gone on from."""
    (tmp_path / "model.json").write_text(MODEL.to_json())
    short = replace(
        plain, name="short </script>", vertices=plain.vertices[:20], pinned_positions=plain.pinned_positions[:20]
    )
    write_measurement(short, tmp_path / "short.npz")
    (tmp_path / "strip.csv").write_text("axial_strain,force_per_width_N_per_m\n0,0\n0.1,5\n0.2,11\n0.3,20\n")
    given = [str(tmp_path / name) for name in ("model.json", "short.npz", "strip.csv")]
    kept, going_on, write = tmp_path / "out" / "unfinished-comparison", [], command.write

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    def watched(*found: object) -> None:
        going_on.extend(sorted(kept.iterdir()))
        write(*found)

    monkeypatch.setattr(command, "write", stopped)
    with pytest.raises(KeyboardInterrupt):
        main([*given, "-o", str(tmp_path / "out")])
    files = sorted(kept.iterdir())
    assert files
    monkeypatch.setattr(command, "write", watched)
    main([*given, "-o", str(tmp_path / "out")])
    assert going_on == files  # nothing was rolled out anew
    assert not kept.exists()
    figures = json.loads((tmp_path / "out" / "compare.json").read_text())["comparisons"][0]
    assert figures["error"]["median_mm"] > 0
    page = (tmp_path / "out" / "compare.html").read_text()
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)  # nothing is loaded from anywhere
    assert "http" not in re.sub(r"http://www\.w3\.org/\S+", "", page)
    assert "short &lt;/script&gt;" in page
    assert page.count('class="viewer"') == 1
    assert "tensile tests, 1 loading<" in page
    assert "mm off" in capsys.readouterr().out
    with pytest.raises(CaphyError, match="there is no model 'silk'"):
        main(["silk", str(tmp_path / "short.npz"), "-o", str(tmp_path / "out")])


def test_the_avatar_that_comes_along_is_compared_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_model("default").name == "default"
    with pytest.raises(CaphyError, match="there is no model 'tshirt'"):
        load_model("tshirt")  # a bundled garment, which is none
