"""Tangents along roll-outs against differences of whole roll-outs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explicit_cloth import measured, simulate

from caphy.effects.model import Model
from caphy.measure.scene import Scene
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


def responded(watched: Watched, model: Model, columns=(), offset=None):
    return next(watched.respond(model, columns, {START: offset}))


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


@pytest.mark.parametrize("number", [1, 5, 30, 61, 62, 100])
def test_nuisances_are_derivatives_by_the_start(watched, number):
    here = responded(watched, DAMPED)
    offset = np.zeros(here.nuisance.shape[-1])
    offset[number] = 0.01
    there = responded(watched, DAMPED, (), offset)
    difference = -(there.residual - here.residual) / 0.01
    tangent = here.nuisance[..., number]
    assert np.linalg.norm(difference - tangent) < 0.02 * np.linalg.norm(tangent)


def test_holes_leave_the_rest_of_a_window_as_it_was(watched):
    measurement = watched.scene.measurement
    vertices = measurement.vertices.copy()
    vertices[START + 2] = np.nan
    holed = Watched(Scene.of(replace(measurement, vertices=vertices)), length=5)
    found = next(holed.respond(DAMPED, (), {START: None}))
    assert found.seen.tolist() == [True, False, True, True, True]
    assert not found.residual[1].any()
