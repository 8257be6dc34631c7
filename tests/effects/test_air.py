"""Drag and wind against the closed forms of a sheet that falls or is blown along."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from situations import DENSITY, gradient, lying, moving, rolled_out

from caphy.effects.air import FASTEST
from caphy.effects.base import Step
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect
from caphy.effects.trial import flat_cloth, irregular_cloth, moment
from caphy.solve.integrators import State

G = 9.81
LAWS = ["air_drag_normal", "air_drag_normal_quadratic", "air_drag_tangential", "air_drag_tangential_quadratic"]


@pytest.mark.parametrize("law", LAWS)
def test_a_falling_sheet_nears_its_terminal_velocity(law: str) -> None:
    """V (1 - exp(-g t / V)) with V = rho g / c, and V tanh(g t / V) with V = sqrt(rho g / c); flat or edge on."""
    cloth = lying(2, 2) if "normal" in law else flat_cloth(2, 2)
    quadratic, c, t = law.endswith("quadratic"), 1.5, 0.3
    effects: dict[str, Any] = {"inertia": {}, "gravity": {}, law: {"coefficient": c}}
    x = torch.as_tensor(cloth.vertices).clone()
    state, reports = rolled_out(
        Potential(Model(DENSITY, effects), cloth), State(0.0, x, torch.zeros_like(x)), 20, t / 20
    )
    assert all(report.converged for report in reports)
    terminal = np.sqrt(DENSITY * G / c) if quadratic else DENSITY * G / c
    wanted = terminal * (np.tanh(G * t / terminal) if quadratic else 1 - np.exp(-G * t / terminal))
    np.testing.assert_allclose(-state.v[:, 1], wanted, rtol=1e-3)
    assert wanted > 0.8 * terminal


@pytest.mark.parametrize("law", ["normal_quadratic", "tangential", "tangential_quadratic"])
def test_drag_spares_the_other_direction(law: str) -> None:
    cloth = lying()
    velocity = torch.tensor((0.6, 0.0, 0.3) if "normal" in law else (0.0, 0.6, 0.0), dtype=torch.float64)
    x = torch.as_tensor(cloth.vertices)
    force = gradient(cloth, x, moving(x, velocity), **{f"air_drag_{law}": {}})
    assert float(force.abs().max()) < 1e-15


@pytest.mark.parametrize("direction", ["normal", "tangential"])
@pytest.mark.parametrize("quadratic", [False, True])
def test_wind_is_drag_seen_from_the_air(direction: str, quadratic: bool) -> None:
    cloth, c = irregular_cloth(), 0.8
    at, wind = moment(cloth), torch.tensor((1.3, -0.4, 2.1), dtype=torch.float64)
    suffix = f"{direction}_quadratic" if quadratic else direction
    values: dict[str, Any] = {"coefficient": c} | ({"velocity": wind} if quadratic else {"push": c * wind})
    blown = gradient(cloth, at.x, at.step, **{f"wind_{suffix}": values})
    step = at.step
    carried = Step(step.dt, step.origin + step.dt * wind, step.target, step.lagged, step.lagged_velocity)
    torch.testing.assert_close(blown, gradient(cloth, at.x, carried, **{f"air_drag_{suffix}": {"coefficient": c}}))


def test_a_wind_field_pushes_by_its_pressure_at_each_place() -> None:
    cloth = flat_cloth(8, 8)  # faces z
    x = torch.as_tensor(cloth.vertices) + torch.tensor((1.0, 2.0, 3.0), dtype=torch.float64)
    slope = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.5, -0.7, 0.2))
    force = -gradient(cloth, x, moving(x, torch.zeros(3)), wind_field={"gradient": slope}).sum(0)
    pressure = 0.5 * (1 + 0.06) - 0.7 * (2 + 0.05) + 0.2 * 3
    np.testing.assert_allclose(force, [0, 0, 0.012 * pressure], atol=1e-14)


@pytest.mark.parametrize("time", [0.0, 0.1, 0.35])
def test_a_gust_swings(time: float) -> None:
    cloth = flat_cloth()
    x = torch.as_tensor(cloth.vertices)
    values = {"cosine": (0, 0, 0.4), "sine": (9, 9, 0.3), "frequency": 2.0}
    force = -gradient(cloth, x, Step.implicit_euler(1 / 30, x, x, time), gust=values).sum(0)
    phase = 2 * np.pi * 2 * time
    np.testing.assert_allclose(force, [0, 0, 0.012 * (0.4 * np.cos(phase) + 0.3 * np.sin(phase))], atol=1e-14)


def test_a_gust_keeps_the_clock_of_the_simulation() -> None:
    """A free sheet blown by f0 sin(2 pi nu t) moves by f0 / (rho w) (t - sin(w t) / w)."""
    cloth, f0, nu, t = flat_cloth(2, 2), 0.4, 1.5, 0.5
    effects: dict[str, Any] = {
        "inertia": {},
        "gust": {"cosine": (0, 0, 0), "sine": (0, 0, f0), "frequency": nu},
    }
    x = torch.as_tensor(cloth.vertices).clone()
    state, _ = rolled_out(Potential(Model(DENSITY, effects), cloth), State(0.0, x, torch.zeros_like(x)), 30, t / 30)
    w = 2 * np.pi * nu
    np.testing.assert_allclose(state.x[:, 2], f0 / (DENSITY * w) * (t - np.sin(w * t) / w), rtol=2e-3)


def test_velocities_decay_at_the_rate_of_mass_damping() -> None:
    cloth = flat_cloth(2, 2)
    effects: dict[str, Any] = {"inertia": {}, "mass_damping": {"rate": 3.0}}
    x = torch.as_tensor(cloth.vertices).clone()
    start = torch.tensor((0.5, -1.0, 2.0), dtype=torch.float64).expand_as(x).clone()
    state, _ = rolled_out(Potential(Model(DENSITY, effects), cloth), State(0.0, x, start), 20, 0.03)
    torch.testing.assert_close(state.v, start * np.exp(-3.0 * 0.6), rtol=2e-3, atol=0)


def test_pressure_is_p_a_n() -> None:
    cloth = irregular_cloth()
    at = moment(cloth)
    wanted = np.zeros_like(cloth.vertices)
    for corners in cloth.faces:
        a, b, c = at.step.lagged.numpy()[corners]
        for corner in corners:
            wanted[corner] += 2.5 / 3 * 0.5 * np.cross(b - a, c - a)
    force = -gradient(cloth, at.x, at.step, pressure={"pressure": 2.5})
    np.testing.assert_allclose(force, wanted, atol=1e-16)


@pytest.mark.parametrize("side", ["normal", "tangential"])
def test_a_quadratic_wind_starts_with_the_push_of_a_linear_one(side: str) -> None:
    """On resting cloth that faces it, or lies along it, both push alike; cloth that flies with it is left alone."""
    cloth, push = lying(), np.array([0.0, 0.6, 0.0] if side == "normal" else [0.6, 0.0, 0.0])
    linear, law = f"wind_{side}", f"wind_{side}_quadratic"
    values = find_effect(law).start({"coefficient": np.array(0.3), "push": push})
    np.testing.assert_allclose(values["velocity"], push / 0.3)
    x = torch.as_tensor(cloth.vertices)
    step = moving(x, torch.zeros(3))
    wanted = gradient(cloth, x, step, **{linear: {"coefficient": 0.3, "push": push}})
    assert wanted.abs().max() > 1e-5
    torch.testing.assert_close(gradient(cloth, x, step, **{law: values}), wanted)
    with_the_wind = moving(x, torch.as_tensor(values["velocity"]))
    assert gradient(cloth, x, with_the_wind, **{law: values}).abs().max() < 1e-9


def test_a_push_without_drag_is_a_fast_wind() -> None:
    values = find_effect("wind_normal_quadratic").start(
        {"coefficient": np.array(0.0), "push": np.array([0.0, 0.0, 1.0])}
    )
    np.testing.assert_allclose(values["velocity"], [0.0, 0.0, FASTEST])
    assert values["coefficient"] == pytest.approx(1.0 / FASTEST**2)


@pytest.mark.parametrize("side", ["normal", "tangential"])
def test_a_quadratic_wind_starts_within_its_bounds(side: str) -> None:
    """A push of hardly anything with all its drag is no wind of 0.8 mm/s and 1,440 kg/m^3."""
    law, push = f"wind_{side}_quadratic", np.array([0.0, 0.0, 1e-3])
    for size in (1.0, 1e-9, 0.0):
        values = find_effect(law).start({"coefficient": np.array(1.2), "push": size * push})
        taken = Model(DENSITY, {law: values}).effects[law]
        np.testing.assert_allclose(taken["coefficient"] * taken["velocity"][2] ** 2, size * push[2], atol=1e-11)
