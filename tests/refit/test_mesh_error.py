"""What a coarse mesh gets wrong, told by a finer one, on cloth that an independent explicit integrator moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import measured, simulate, square, staggered

from caphy.challenge.hidden import Hidden
from caphy.challenge.recording import record, seen_by_user
from caphy.challenge.square import MODEL as SOFT
from caphy.challenge.square import square as sheet
from caphy.diagnose.base import from_base
from caphy.effects.model import Model
from caphy.garment.lattice import Lattice
from caphy.measure.comparison import compare
from caphy.measure.prediction import predict_in_windows
from caphy.measure.scene import Scene
from caphy.refit.columns import addition
from caphy.refit.evidence import evidence, robust_weights
from caphy.refit.study import Study, fit, retold

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
FRAMES = 33


def hung(fine: bool, **hidden) -> Scene:
    """Cloth on a mesh of its own with edges half as long, or on the model's own, seen at the model's vertices."""
    mesh, count, steps = (staggered, 17, 240) if fine else (square, 9, 120)
    positions, keys = simulate(mesh=mesh, count=count, steps=steps, settle=2.0, tempo=1.2, **hidden)
    rest, faces, flat = square(9)
    there = mesh(count)[0]
    seen = np.array([np.linalg.norm(there - place, axis=1).argmin() for place in rest])
    np.testing.assert_allclose(there[seen], rest, atol=1e-12)
    keys |= {"faces": faces, "rest_vertices": rest, "material": flat[faces], "pinned": np.array([0, 8])}
    return Scene.of(measured(positions[:, seen], keys, noise_mm=0.3))


@pytest.fixture(scope="module")
def scenes() -> dict[bool, Scene]:
    return {fine: hung(fine) for fine in (True, False)}


@pytest.fixture(scope="module")
def told(scenes) -> dict[bool, tuple[np.ndarray, float]]:
    """How much of the mesh's error each window asks for, and the share of the misfit that one amount takes away."""
    found = {}
    for fine, scene in scenes.items():
        windows = [
            replace(each.with_mesh(0.0), columns=each.of_mesh[..., None]) for each in Study([scene]).respond(MODEL, ())
        ]
        known = evidence(windows, np.full(windows[0].residual.shape[:2], 1e-6))
        normal, right = known.normal
        gain = float(right @ np.linalg.solve(normal, right) / known.c.sum())
        found[fine] = (known.b[:, 0] / known.a[:, 0, 0], gain)
    return found


def test_a_finer_mesh_tells_what_the_coarse_one_gets_wrong(told):
    amounts, gain = told[True]
    assert gain > 0.3
    assert abs(np.median(amounts) - 1) < 0.25
    assert (amounts > 0.5).all()


def test_where_the_mesh_is_the_cloths_own_nothing_is_the_meshs_error(told):
    amounts, gain = told[False]
    assert gain < 0.01
    assert (np.abs(amounts) < 0.1).all()


def test_base_measurements_tell_how_much_of_it_is_there(scenes):
    assert from_base(Study([scenes[False]]), MODEL).mesh < 0.1
    assert abs(from_base(Study(filmed(Hidden("nothing"))), SOFT).mesh - 1) < 0.2


def test_a_comparison_says_what_is_due_to_the_mesh(scenes):
    coarse, own = (
        compare(predict_in_windows(scenes[fine], MODEL), scenes[fine].measurement).figures for fine in (True, False)
    )
    assert coarse["floor"]["mesh_median_mm"] > 0.5 * coarse["error"]["median_mm"]
    assert own["floor"]["mesh_median_mm"] < 0.05


def filmed(hidden: Hidden) -> list[Scene]:
    """Two motions of the challenge's square, which its own explicit integrator moves on an irregular, finer mesh."""
    stage = sheet(1, FRAMES)
    plays = [play for play in stage.plays if play.part == "train"][:2]
    films = [record(stage, play, hidden, 1, FRAMES, None) for play in plays]
    return [
        Scene.of(seen_by_user(stage, play, film, 0.3, None, np.random.default_rng(play.number)))
        for play, film in zip(plays, films, strict=True)
    ]


def fits(scenes: list[Scene], effect: str, mesh: float) -> list[float]:
    """A number fitted where it is known how much of the mesh's error is there: once, and with it told anew."""
    study, columns = Study(scenes, mesh=mesh), addition(effect)
    windows = study.respond(SOFT, columns, anew={"start", "solver"})
    variance = study.variance(windows)
    weight = robust_weights(evidence(windows, variance))
    once = fit(study, SOFT, columns, windows, variance, weight)
    return [float(each.change[0]) for each in (once, retold(study, once, variance, weight))]


def test_bending_of_cloth_is_measured_on_squares_with_diagonals(monkeypatch):
    """What the finer mesh does is what the cloth does, where it bends in all directions alike."""
    scenes = filmed(Hidden("bending", {"extra_bending": {"stiffness": 6e-5}}))
    once, again = fits(scenes, "extra_bending", 1.0)
    assert abs(again / 6e-5 - 1) < 0.1
    assert abs(again / 6e-5 - 1) < abs(once / 6e-5 - 1)
    monkeypatch.setattr(Lattice, "of", lambda *cloth: None)
    _, quartered = fits(scenes, "extra_bending", 1.0)
    assert quartered / 6e-5 - 1 < -0.2
