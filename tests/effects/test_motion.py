"""Gravity, inertia, drag, friction, contact and attachment against elementary mechanics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from caphy.effects.base import BodyState, Step
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import DT, flat_cloth

UP = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
WEIGHT = 0.2 * 9.81  # N/m^2


def lying(cloth: Cloth) -> torch.Tensor:
    """A flat cloth turned to lie in the horizontal plane."""
    return torch.as_tensor(cloth.vertices)[:, [0, 2, 1]]


def floor(x: torch.Tensor, height: float = 0.0, velocity: tuple[float, float, float] = (0, 0, 0)) -> BodyState:
    """A horizontal floor that moves along itself."""
    point = x * torch.tensor((1.0, 0.0, 1.0)) + height * UP
    moving = torch.tensor(velocity, dtype=torch.float64).expand_as(x)
    return BodyState(point, UP.expand_as(x), moving, x.clone())


def gradient(x: torch.Tensor, step: Step | None, body: BodyState | None, **effects: Any) -> torch.Tensor:
    return Potential(Model(0.2, effects), flat_cloth()).gradient(x, step, body)[1]


def test_weight_is_density_times_area() -> None:
    force = gradient(lying(flat_cloth()), None, None, gravity={}).sum(0)
    torch.testing.assert_close(force, 0.012 * WEIGHT * UP)


def test_free_fall_is_implicit_euler() -> None:
    before = lying(flat_cloth())
    previous = before - 0.1 * UP
    x = 2 * previous - before - 9.81 * DT**2 * UP
    force = gradient(x, Step.implicit_euler(DT, previous, before), None, gravity={}, inertia={})
    assert float(force.abs().max()) < 1e-12


def test_terminal_velocity_is_weight_over_drag() -> None:
    x = lying(flat_cloth())
    falling = WEIGHT / 1.2 * UP * DT
    step = Step.implicit_euler(DT, x + falling, x + 2 * falling)
    force = gradient(x, step, None, gravity={}, air_drag_normal={"coefficient": 1.2}, inertia={})
    assert float(force.abs().max()) < 1e-12


def test_drag_spares_motion_along_the_cloth() -> None:
    x = lying(flat_cloth())
    sliding = torch.tensor((0.02, 0.0, 0.01), dtype=torch.float64)
    force = gradient(x, Step.implicit_euler(DT, x - sliding, x - 2 * sliding), None, air_drag_normal={})
    assert float(force.abs().max()) < 1e-15


def test_contact_pressure_is_three_stiffness_depth_squared() -> None:
    cloth = flat_cloth()
    contact = {"stiffness": 1e8, "distance": 0.004}
    x = lying(cloth) + (0.004 + 0.001 - 0.0005) * UP  # layers of 1 mm, half a millimetre too near
    force = gradient(x, None, floor(x), body_contact=contact)
    torch.testing.assert_close(force, torch.as_tensor(-3e8 * 0.0005**2 * cloth.vertex_area)[:, None] * UP)
    away = x + 0.0006 * UP
    assert float(gradient(away, None, floor(away), body_contact=contact).abs().max()) == 0


@pytest.mark.parametrize("pressure", [WEIGHT, 20 / 0.07])
def test_default_contact_gives_by_less_than_a_millimetre(pressure: float) -> None:
    """Under the cloth's own weight, and under a cloth stretched by 20 N/m round a limb of 7 cm radius."""
    x = lying(flat_cloth()) + (0.005 - 0.001) * UP
    push = -gradient(x, None, floor(x), body_contact={})[:, 1].sum() / 0.012
    assert float(push) > pressure


@pytest.mark.parametrize("lift", [0.0, 0.6, -0.6])
def test_friction_slides_at_the_coefficient_and_sticks_below_it(lift: float) -> None:
    """On a floor that slides under the cloth, and rises or sinks with it."""
    cloth = flat_cloth()
    x = lying(cloth) + 0.0045 * UP  # half a millimetre deep
    normal_force = 3e8 * 0.0005**2 * 0.012
    effects: dict[str, Any] = {"body_contact": {}, "body_friction": {"coefficient": 0.3, "slip": 0.001}}
    step = Step.implicit_euler(DT, x, x)
    for speed, share in ((1.0, 1.0), (0.001, 1 / np.sqrt(2)), (0.0, 0.0)):
        body = floor(x, velocity=(speed, lift, 0))
        body = BodyState(body.point + DT * body.velocity, body.normal, body.velocity, body.anchor)
        pulled = -gradient(x + DT * lift * UP, step, body, **effects).sum(0)
        assert float(pulled[0]) == pytest.approx(0.3 * normal_force * share, rel=1e-4, abs=1e-12)
        assert float(pulled[1]) == pytest.approx(normal_force, rel=1e-9)


def test_attachment_pulls_back_by_strength_and_area() -> None:
    cloth = flat_cloth()
    x = lying(cloth)
    body = floor(x)
    shifted = x + 0.001 * UP
    pull = gradient(shifted, None, body, attachment={"stiffness": 1e6})
    wanted = torch.as_tensor(1e6 * cloth.attached * cloth.vertex_area * 0.001)
    torch.testing.assert_close(pull, wanted[:, None] * UP)
