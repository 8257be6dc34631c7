"""Static drapes: the minimum of the potential without inertia."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Body, Newton, Report

_FIRST_STEP = 1 / 30
"""Pseudo-time step of the first iteration [s]; it doubles with every full one."""


def drape(newton: Newton, guess: Tensor, body: Body | None = None) -> tuple[Tensor, Report]:
    """Positions of rest (V, 3) [m] near a guess, and whether they were reached.

    Newton's method damped by mass as if time passed (Levenberg and Marquardt), so that folds fall one way instead of
    balancing, and cloth that nothing holds sinks slowly enough to meet the body. What acts in steps alone (wind, drag,
    pressure, friction, damping) is left out.
    """
    return newton.resolving().minimise(guess, None, body, damping=1 / _FIRST_STEP**2)


def drape_on_body(newton: Newton, motion: BodyMotion, time: float = 0.0) -> tuple[Tensor, Report]:
    """The garment at rest on the body as it stands at a time [s], from the skinned template."""
    guess = torch.from_numpy(motion.anchors(np.array([time]))[0].copy())
    return drape(newton, guess, lambda x: motion.state(time, x.numpy(), 1.0))
