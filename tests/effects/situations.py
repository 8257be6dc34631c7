"""Cloths, floors and roll-outs that several tests of effects share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import BodyState, Step
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.trial import flat_cloth
from caphy.solve.integrators import SDIRK2, Integrator, State
from caphy.solve.newton import Newton, Report

DENSITY = 0.2


def gradient(
    cloth: Cloth, x: Tensor, step: Step | None = None, body: BodyState | None = None, **effects: Any
) -> Tensor:
    """Gradient (V, 3) [N] of a model of these effects."""
    return Potential(Model(cloth.density, effects), cloth).gradient(x, step, body)[1]


def moving(x: Tensor, velocity: Tensor, dt: float = 1 / 30) -> Step:
    """The implicit Euler step that ends at x (V, 3) [m] after motion at a velocity [m/s]."""
    return Step.implicit_euler(dt, x - dt * velocity, x - 2 * dt * velocity)


def lying(columns: int = 6, rows: int = 5) -> Cloth:
    """A flat cloth in the horizontal plane, its normal up, 1 mm of layers."""
    flat = flat_cloth(columns, rows)
    vertices = flat.vertices[:, [0, 2, 1]] * (1, 1, -1)
    return Cloth(vertices, flat.faces, flat.material, DENSITY, flat.layer_thickness, flat.attached)


def plane(normal: Tensor, anchor: Tensor) -> Callable[[Tensor], BodyState]:
    """A body at rest that fills the half-space below the origin."""

    def seen(x: Tensor) -> BodyState:
        point = x - (x @ normal)[:, None] * normal
        return BodyState(point, normal.expand_as(x), torch.zeros_like(x), anchor)

    return seen


def rolled_out(
    potential: Potential,
    state: State,
    steps: int,
    dt: float,
    integrator: Integrator | None = None,
    fixed: np.ndarray | None = None,
    body: Callable[[Tensor], BodyState] | None = None,
    tolerance: float = 1e-9,
) -> tuple[State, list[Report]]:
    """The state after some steps, and the reports of all minimisations."""
    newton, reports = Newton(potential, fixed, tolerance=tolerance), []

    def solve(step: Step, time: float) -> Tensor:
        guess = step.target.clone()
        if fixed is not None:
            guess[torch.from_numpy(fixed)] = step.lagged[torch.from_numpy(fixed)]
        x, report = newton.minimise(guess, step, body)
        reports.append(report)
        return x

    for _ in range(steps):
        state = (integrator or SDIRK2()).advance(state, dt, solve)
    return state, reports
