"""Every effect in the solver: it converges, and the effect shows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from situations import DENSITY, lying, plane, rolled_out

from caphy.effects.candidates import candidates
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.effects.registry import find_effect
from caphy.effects.trial import flat_cloth
from caphy.solve.integrators import ImplicitEuler, State
from caphy.solve.newton import TOLERANCE

UP = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
CLOTH = flat_cloth()
START = torch.as_tensor(CLOTH.vertices) * 1.02 + 0.002 * UP
PINNED = (CLOTH.vertices[:, 0] == 0) & (CLOTH.vertices[:, 1] > 0.0999)
BASE = snug_model().with_effect("body_friction").without_effect("attachment")


def rollout(model: Model, tolerance: float = 1e-6) -> torch.Tensor:
    """A stretched upright cloth, swinging about one pinned corner, whose lower edge touches a floor."""
    velocity = 0.3 * torch.sin(40 * START.flip(1))
    velocity[torch.from_numpy(PINNED)] = 0
    body = plane(UP, START)
    potential = Potential(model, CLOTH)
    state, reports = rolled_out(
        potential, State(0.0, START, velocity), 2, 1 / 30, fixed=PINNED, body=body, tolerance=tolerance
    )
    for report in reports:
        assert report.converged, report
    return state.x


@pytest.fixture(scope="module")
def base() -> torch.Tensor:
    return rollout(BASE)


@pytest.mark.parametrize("name", [name for name in candidates(BASE) if name != "strain_measured"])
def test_each_effect_converges_and_shows(name: str, base: torch.Tensor) -> None:
    moved = rollout(BASE.with_effect(name)) - base
    assert 1e-7 < float(moved.abs().max()) < 0.12


def test_all_effects_together_converge() -> None:
    model = BASE
    for name in candidates(BASE):
        if find_effect(name).group not in ("contact", "external") or name in ("contact_thickness", "pressure"):
            model = model.with_effect(name)
    x = rollout(model, TOLERANCE)
    assert bool(x.isfinite().all()) and float((x - START).abs().max()) < 0.3


@pytest.mark.parametrize(("slope", "slides"), [(0.45, True), (0.2, False)])
def test_cloth_slides_where_the_slope_is_steeper_than_friction(slope: float, slides: bool) -> None:
    """Beyond tan(angle) = mu it slides at g (sin - mu cos), below it creeps slower than the slip speed."""
    mu, angle, t = 0.3, np.arctan(slope), 0.25
    tilted = [-9.81 * np.sin(angle), -9.81 * np.cos(angle), 0.0]
    effects: dict[str, Any] = {
        "gravity": {"acceleration": tilted},
        "inertia": {},
        "body_contact": {},
        "body_friction": {"coefficient": mu, "slip": 0.002},
    }
    cloth = lying(2, 2)
    depth = np.sqrt(DENSITY * 9.81 * np.cos(angle) / 3e8)
    x = torch.as_tensor(cloth.vertices) + (0.005 - depth) * UP
    start = State(0.0, x, torch.zeros_like(x))
    potential = Potential(Model(DENSITY, effects), cloth)
    state, reports = rolled_out(potential, start, 25, t / 25, ImplicitEuler(), body=plane(UP, x))
    assert all(report.converged for report in reports)
    speed = -state.v[:, 0].numpy()
    if slides:
        np.testing.assert_allclose(speed, 9.81 * (np.sin(angle) - mu * np.cos(angle)) * t, rtol=0.01)
    else:
        assert speed.min() >= 0 and speed.max() < 0.002
