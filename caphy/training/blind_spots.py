"""What acts on the cloth but is hidden from the network: heading, place and the clock are not among its features."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import BodyState, Step
from caphy.effects.potential import Potential
from caphy.rotations import matrix_from_axis_angle

TURN = (0.0, 2.1, 0.0)
"""A turn about the vertical [rad]."""
SHIFT = (3.0, 0.0, -2.0)
"""A horizontal move [m]."""
DELAY = 0.37
"""Time by which the clock is moved [s]."""


def blind_spots(potential: Potential) -> dict[str, str]:
    """Effects whose forces depend on what the network does not see, name -> on what.

    It learns such a force's average over its training motions (with the right heading, place or time it would follow).
    Told by experiment: cloth in motion is turned about the vertical, moved, and met later; its forces must turn along,
    stay, and stay.
    """
    exact = Potential(potential.model, potential.cloth)
    x, step, body = _in_motion(exact)
    turn = torch.tensor(matrix_from_axis_angle(np.array(TURN)))
    shift = torch.tensor(SHIFT, dtype=torch.float64)
    plain = exact.term_gradients(x, step, body)
    turned = exact.term_gradients(x @ turn.T, step.map(lambda field: field @ turn.T), body.map(lambda f: f @ turn.T))
    moved = exact.term_gradients(x + shift, _step_moved(step, shift), _body_moved(body, shift))
    later = exact.term_gradients(x, replace(step, time=step.time + DELAY), body)
    found: dict[str, list[str]] = {}
    for what, forces in (
        ("heading", {name: force @ turn for name, force in turned.items()}),
        ("place", moved),
        ("time", later),
    ):
        for name, force in forces.items():
            if (force - plain[name]).norm() > 1e-6 * plain[name].norm():
                found.setdefault(name, []).append(what)
    return {name: " and ".join(whats) for name, whats in found.items()}


def _in_motion(potential: Potential) -> tuple[Tensor, Step, BodyState]:
    """Crumpled cloth on its way, some of it in touch with a body."""
    random = np.random.default_rng(0)

    def some(size: float) -> Tensor:
        return torch.tensor(random.normal(scale=size, size=potential.cloth.vertices.shape))

    x = torch.tensor(potential.cloth.vertices, dtype=torch.float64) + some(1e-3)
    normal = torch.nn.functional.normalize(some(1.0), dim=-1)
    body = BodyState(x - 0.002 * normal, normal, some(0.1), x + some(1e-3))
    return x, Step.implicit_euler(1 / 30, x - some(0.02), x - some(0.04), 0.2), body


def _step_moved(step: Step, shift: Tensor) -> Step:
    return replace(step, origin=step.origin + shift, target=step.target + shift, lagged=step.lagged + shift)


def _body_moved(body: BodyState, shift: Tensor) -> BodyState:
    return replace(body, point=body.point + shift, anchor=body.anchor + shift)
