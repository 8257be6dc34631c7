"""Tangents along roll-outs against differences of whole roll-outs."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from explicit_cloth import measured, simulate

from caphy.effects.base import HISTORY
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import irregular_cloth, moment
from caphy.measure.scene import Scene
from caphy.refit import responses, tangents
from caphy.refit.columns import Column, moved
from caphy.refit.responses import Watched

DAMPED = Model(
    0.2,
    {
        "inertia": {},
        "gravity": {},
        "strain_stvk": {},
        "bending": {},
        "bending_damping": {"viscosity": 2e-6},
        "air_drag_normal": {"coefficient": 0.2},
    },
)
START = 12


@pytest.fixture(scope="module")
def watched() -> Watched:
    positions, keys = simulate(seconds=1.0, settle=1.5)
    return Watched(Scene.of(measured(positions, keys)), length=5)


def responded(watched: Watched, model: Model, columns=()):
    return next(watched.respond(model, columns, [START]))


@pytest.mark.parametrize(
    ("column", "step", "most"),
    [
        (Column("air_drag_normal", "coefficient"), 1e-3, 0.01),
        (Column("air_drag_tangential", "coefficient"), 1e-3, 0.01),
        (Column("wind_normal", "push", (0,)), 1e-3, 0.01),
        (Column("gust", "sine", (2,)), 1e-3, 0.01),
        (Column("pressure", "pressure"), 1e-3, 0.02),
        (Column("viscous_damping", "viscosity"), 1e-3, 0.05),
        (Column("uniform_acceleration", "acceleration", (0,)), 1e-3, 0.02),
    ],
    ids=lambda value: value.name if isinstance(value, Column) else None,
)
def test_responses_are_derivatives_of_the_roll_out(watched, column, step, most):
    here = responded(watched, DAMPED, (column,))
    there = responded(watched, moved(DAMPED, (column,), np.array([step])))
    difference = -(there.residual - here.residual) / step
    tangent = here.columns[..., 0]
    assert np.linalg.norm(difference - tangent) < most * np.linalg.norm(tangent)


@pytest.fixture(scope="module")
def on_ball() -> Watched:
    """The same cloth, a ball behind it."""
    positions, keys = simulate(seconds=1.0, settle=1.5)
    ball = trimesh.creation.icosphere(2, radius=0.1)
    centre = positions[START].mean(0) + np.array([0, 0, 0.1])
    body = np.broadcast_to(ball.vertices + centre, (len(positions), *ball.vertices.shape))
    scene = Scene.of(
        replace(measured(positions, keys), body_vertices=body, body_faces=np.asarray(ball.faces, np.int32))
    )
    return Watched(scene, length=5)


def test_the_response_to_dry_friction_is_that_of_a_roll_out_with_it(on_ball):
    """Friction stops what slides with its first bit: the derivative at zero says nothing of what more of it does."""
    watched, model = on_ball, DAMPED.with_effect("body_contact")
    column = Column("body_friction", "coefficient")
    here, there = responded(watched, model, (column,)), responded(watched, moved(model, (column,), np.array([0.3])))
    told = here.columns[..., 0]
    assert np.abs(told).max() > 1e-4
    np.testing.assert_allclose(-(there.residual - here.residual) / 0.3, told, atol=1e-9)


def test_friction_that_is_there_is_told_by_tangents(on_ball):
    """In proportion too: only its first bit does all."""
    model = DAMPED.with_effect("body_contact").with_effect("body_friction", coefficient=0.3)
    assert not on_ball._abrupt(model, (Column("body_friction", "coefficient", None),))
    assert not on_ball._abrupt(model, (Column("body_friction", "coefficient"),))
    assert on_ball._abrupt(model.without_effect("body_friction"), (Column("body_friction", "coefficient"),))


@pytest.mark.parametrize("few", [12, 0], ids=["along", "by matrices"])
def test_more_friction_than_there_is_moves_cloth_as_roll_outs_do(on_ball, few, monkeypatch):
    """Its push is that of where each step ends, which tangents take as it is: hence a tenth."""
    monkeypatch.setattr(tangents, "_FEW", few)
    model = DAMPED.with_effect("body_contact").with_effect("body_friction", coefficient=0.3)
    column = Column("body_friction", "coefficient")
    here, there = (responded(on_ball, each, (column,)) for each in (model, moved(model, (column,), np.array([0.01]))))
    difference = -(there.residual - here.residual) / 0.01
    assert np.linalg.norm(difference - here.columns[..., 0]) < 0.1 * np.linalg.norm(difference)


@pytest.mark.parametrize("number", [2, 6, 31, 62, 63, 101])
def test_nuisances_are_derivatives_by_the_start(watched, number, monkeypatch):
    here = responded(watched, DAMPED)
    sharpened = watched._sharpened

    def nudged(states, frame):
        state, blur = sharpened(states, frame)
        errors = watched._start(blur)
        x, v = (0.01 * field[number - 2] * watched._free for field in (errors.x, errors.v))
        return replace(state, x=state.x + x, v=state.v + v), blur

    monkeypatch.setattr(watched, "_sharpened", nudged)
    there = responded(watched, DAMPED)
    difference = -(there.residual - here.residual) / 0.01
    tangent = here.nuisance[..., number]
    assert np.linalg.norm(difference - tangent) < 0.02 * np.linalg.norm(tangent)


def test_few_columns_and_many_are_told_alike(watched, monkeypatch):
    """Of few columns the history is told along each, of many by matrices."""
    model = DAMPED.with_effect("viscous_damping", viscosity=1.0).with_effect("hysteresis", friction=0.1)
    columns = (Column("viscous_damping", "viscosity"), Column("air_drag_normal", "coefficient"))
    responded(watched, model)  # what errors of the start do is known from here on
    along = responded(watched, model, columns).columns
    monkeypatch.setattr(tangents, "_FEW", 0)
    by_matrices = responded(watched, model, columns).columns
    assert np.abs(along - by_matrices).max() < 1e-4 * np.abs(by_matrices).max()


def test_holes_leave_the_rest_of_a_window_as_it_was(watched):
    measurement = watched.scene.measurement
    vertices = measurement.vertices.copy()
    vertices[START + 2] = np.nan
    holed = Watched(Scene.of(replace(measurement, vertices=vertices)), length=5)
    found = next(holed.respond(DAMPED, (), [START]))
    assert found.seen.tolist() == [True, False, True, True, True]
    assert not found.residual[1].any()


@pytest.mark.parametrize("lead", [0.0, 1 + np.sqrt(2)], ids=["first stage", "second stage"])
def test_bending_damping_of_another_past_is_told_as_by_differences(lead):
    cloth = irregular_cloth()
    at = moment(cloth)
    step = replace(at.step, lead=lead)
    potential = Potential(Model(cloth.density, {"bending_damping": {}}), cloth)
    stage, random = tangents.Stage(step, at.x, None), np.random.default_rng(0)
    fields = {name: torch.from_numpy(random.normal(0, 1e-3, (5, *at.x.shape))) for name in HISTORY}
    change, told = replace(step, **fields), torch.zeros((5, *at.x.shape), dtype=torch.float64)
    loop = potential.loop(potential.terms["bending_damping"], at.x, step, None)
    assert loop is not None
    tangents._of_damping(loop, stage, change, told)
    wanted = tangents._along_history(potential, "bending_damping", stage, change)
    torch.testing.assert_close(told, wanted, rtol=0, atol=1e-5 * float(wanted.abs().max()))


@pytest.mark.parametrize(("default", "told"), [((0.3, 0.2), {1: (0.2, "its simulator")}), ((0.3, 0.0), {})])
def test_what_is_abrupt_is_rolled_out_with_its_default_of_each_entry(monkeypatch, default, told):
    """Of friction along weft and warp, say; what is nothing by default is told by tangents."""
    monkeypatch.setattr(responses, "find_effect", lambda _: SimpleNamespace(abrupt=True, needs_body=False))
    monkeypatch.setattr(responses, "moved", lambda *_: None)
    monkeypatch.setattr(responses, "_simulator", lambda *_: "its simulator")
    here = {"effect": "mine", "declared": SimpleNamespace(default=default), "value": lambda _: 0.0}
    columns = [SimpleNamespace(entry=None, **here), SimpleNamespace(entry=(1,), **here)]
    assert Watched._abrupt(SimpleNamespace(scene=SimpleNamespace(motion=None)), None, columns) == told
