"""What a coarse mesh gets wrong, told by a finer one, on cloth that an independent explicit integrator moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import measured, simulate, square

from caphy.diagnose.base import from_base
from caphy.effects.model import Model
from caphy.measure.comparison import compare
from caphy.measure.prediction import predict_in_windows
from caphy.measure.scene import Scene
from caphy.refit.columns import addition, tunable
from caphy.refit.evidence import evidence, robust_weights
from caphy.refit.responses import MESH, Watched
from caphy.refit.study import Study, fit, retold

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})


def hung(fine: bool, **hidden) -> Scene:
    """Cloth on a mesh of twice as many edges, or on the very mesh of the model, seen at the model's vertices."""
    positions, keys = simulate(count=17 if fine else 9, steps=240 if fine else 120, settle=2.0, tempo=1.2, **hidden)
    if fine:
        rest, faces, flat = square(9)
        grid = np.arange(17 * 17).reshape(17, 17)[::2, ::2].ravel()
        seen = np.flatnonzero(np.isin(grid, keys["pinned"]))
        keys |= {"faces": faces, "rest_vertices": rest, "material": flat[faces], "pinned": seen}
        positions = positions[:, grid]
    return Scene.of(measured(positions, keys, noise_mm=0.3))


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
    assert gain > 0.4
    assert (np.abs(amounts - 1) < 0.25).all()


def test_where_the_mesh_is_the_cloths_own_nothing_is_the_meshs_error(told):
    amounts, gain = told[False]
    assert gain < 0.01
    assert (np.abs(amounts) < 0.1).all()


@pytest.mark.parametrize(("fine", "amount"), [(True, 1.0), (False, 0.0)])
def test_base_measurements_tell_how_much_of_it_is_there(scenes, fine, amount):
    base = from_base(Study([scenes[fine]]), MODEL)
    assert abs(base.mesh - amount) < 0.1


def test_a_comparison_says_what_is_due_to_the_mesh(scenes):
    coarse, own = (
        compare(predict_in_windows(scenes[fine], MODEL), scenes[fine].measurement).figures for fine in (True, False)
    )
    assert coarse["floor"]["mesh_median_mm"] > 0.5 * coarse["error"]["median_mm"]
    assert own["floor"]["mesh_median_mm"] < 0.05


def damped(scenes: list[Scene]) -> float:
    """The rate [1/s] of a damping fitted to windows."""
    study, damping = Study(scenes), addition("mass_damping")
    windows = study.respond(MODEL, damping)
    variance = study.variance(windows)
    weight = robust_weights(evidence(windows, variance))
    return float(fit(study, MODEL, damping, windows, variance, weight).change[0])


def test_a_damping_of_finer_cloth_is_measured_on_a_coarse_mesh(monkeypatch):
    """What the mesh holds back is not taken for damping, as it is where its error is not known."""
    scenes, respond = [hung(True, drag=0.6)], Watched._response  # 0.6 / 0.2 = 3 1/s
    known = damped(scenes)

    def without(*given):
        told = respond(*given)
        return replace(told, nuisance=np.delete(told.nuisance, MESH, axis=-1))

    monkeypatch.setattr(Watched, "_response", without)
    unknown = damped(scenes)
    assert abs(known / 3 - 1) < 0.15
    assert unknown / 3 - 1 > 0.4


@pytest.mark.parametrize("times", [1.5, 0.7])
def test_a_stiffness_of_finer_cloth_is_measured_on_a_coarse_mesh(times):
    """Where it is known that all of the mesh's error is there, its change with the stiffness is not taken for more or
    less of it."""
    scene = hung(True, lame=(20.9, 11.1 * times))
    study, mu = Study([scene], mesh=1.0), [c for c in tunable("strain_stvk", MODEL) if c.name.endswith("lame_mu")]
    windows = study.respond(MODEL, mu)
    variance = study.variance(windows)
    weight = robust_weights(evidence(windows, variance))
    once = fit(study, MODEL, mu, windows, variance, weight)
    again = retold(study, once, variance, weight)
    assert abs(1 + again.change[0] - times) < 0.1
    assert again.misfit < once.misfit
