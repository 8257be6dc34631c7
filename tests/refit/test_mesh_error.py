"""What a coarse mesh gets wrong, told by a finer one, on cloth that an independent explicit integrator moved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import measured, simulate

from caphy.challenge.hidden import Hidden
from caphy.challenge.recording import record, seen_by_user
from caphy.challenge.square import MODEL as SOFT
from caphy.challenge.square import square as sheet
from caphy.diagnose.base import from_base
from caphy.effects.model import Model
from caphy.measure.comparison import compare
from caphy.measure.prediction import predict_in_windows
from caphy.measure.scene import Scene
from caphy.refit.columns import addition
from caphy.refit.descent import fit, retold
from caphy.refit.evidence import Weighing, evidence
from caphy.refit.responses import STEP_DOUBT
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
FRAMES = 26
"""Of a film: three windows of 8."""


def filmed(hidden: Hidden, frames: int = FRAMES, motions: int = 2, same_mesh: bool = False) -> list[Scene]:
    """Motions of the challenge's square, which its own explicit integrator moves on an irregular, finer mesh unless it
    is to be the ``same_mesh`` as the model's."""
    stage = sheet(1, frames, same_mesh)
    plays = [play for play in stage.plays if play.part == "train"][:motions]
    films = [record(stage, play, hidden, 1, frames, None) for play in plays]
    return [
        Scene.of(seen_by_user(stage, play, film, 0.3, None, np.random.default_rng(play.number)))
        for play, film in zip(plays, films, strict=True)
    ]


@pytest.fixture(scope="module")
def finer() -> list[Scene]:
    """Cloth of a mesh of its own."""
    return filmed(Hidden("nothing"))


@pytest.fixture(scope="module")
def own() -> list[Scene]:
    """Cloth of the model's very mesh."""
    return [Scene.of(measured(*simulate(settle=2.0, tempo=1.2), noise_mm=0.3))]


def told(scenes: list[Scene], model: Model) -> tuple[np.ndarray, float]:
    """How much of the mesh's error each window asks for, and the share of the misfit that one amount takes away."""
    windows = [
        replace(each.with_mesh(0.0), columns=each.of_mesh[..., None]) for each in Study(scenes).respond(model, ())
    ]
    known = evidence(windows, np.full(windows[0].residual.shape[:2], 1e-6))
    normal, right = known.normal
    gain = float(right @ np.linalg.solve(normal, right) / known.c.sum())
    return known.b[:, 0] / known.a[:, 0, 0], gain


def test_what_finer_steps_do_otherwise_is_taken_from_residuals():
    """On the model's very mesh: two steps a frame damp what rings in a film of steps that are finer by far."""
    found = Study(filmed(Hidden("nothing"), motions=2, same_mesh=True)).respond(SOFT, ())
    windows = [each for each in found if each.start > 1]  # the first ones start from what no frame before them tells
    left = np.stack([each.residual for each in windows])
    of_step = np.stack([each.nuisance[..., 0] for each in windows]) / STEP_DOUBT
    amounts = ((left + of_step) * of_step).sum((1, 2, 3)) / (of_step**2).sum((1, 2, 3))
    assert abs(np.median(amounts) - 1) < 0.1
    assert (left**2).sum() < 0.25 * ((left + of_step) ** 2).sum()


def test_a_finer_mesh_tells_what_the_coarse_one_gets_wrong(finer):
    amounts, gain = told(finer, SOFT)
    assert gain > 0.4
    assert abs(np.median(amounts) - 1) < 0.15
    assert (amounts > 0.3).all()


def test_where_the_mesh_is_the_cloths_own_nothing_is_the_meshs_error(own):
    amounts, gain = told(own, MODEL)
    assert gain < 0.01
    assert (np.abs(amounts) < 0.1).all()


def test_base_measurements_tell_how_much_of_it_is_there(finer, own):
    assert from_base(Study(own), MODEL).mesh < 0.1
    assert abs(from_base(Study(finer), SOFT).mesh - 1) < 0.2


def test_a_comparison_says_what_is_due_to_the_mesh(finer, own):
    coarse, same = (
        compare(predict_in_windows(scene, model), scene.measurement).figures
        for scene, model in ((finer[0], SOFT), (own[0], MODEL))
    )
    assert coarse["floor"]["mesh_median_mm"] > 0.5 * coarse["error"]["median_mm"]
    assert same["floor"]["mesh_median_mm"] < 0.05


def fits(scenes: list[Scene], effect: str, mesh: float) -> Iterator[float]:
    """A number fitted where it is known how much of the mesh's error is there: once, then with it told anew."""
    study, columns = Study(scenes, mesh=mesh), addition(effect)
    windows = study.respond(SOFT, columns, anew={"start", "solver"})
    once = fit(study, SOFT, columns, windows, Weighing.robust(windows, study.variance(windows)))
    yield float(once.change[0])
    yield float(retold(study, once).change[0])


def test_bending_of_cloth_is_measured_on_squares_with_diagonals():
    """What the finer mesh does is what the cloth does, where it bends in all directions alike. One motion alone tells
    5.4e-5."""
    scenes = filmed(Hidden("bending", {"extra_bending": {"stiffness": 6e-5}}), frames=34, motions=2)
    once, again = fits(scenes, "extra_bending", 1.0)
    assert abs(again / 6e-5 - 1) < 0.1
    assert abs(again - 6e-5) < abs(once - 6e-5)
