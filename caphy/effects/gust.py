"""Wind that comes and goes."""

from __future__ import annotations

from math import pi

import torch
from torch import Tensor

from caphy.effects.air import Air
from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.vectors import uniform


class Gust(Air):
    """A wind pressure that swings in time, E = -dt A (f(t).n) (v.n) [J] per face.

    f(t) = a cos(2 pi nu t) + b sin(2 pi nu t) [Pa], the same everywhere, with t counted from the start of the motion.
    Each axis has its own phase, so the wind may also turn. Steady wind and drag are wind_normal's. Networks see
    no clock: they learn the average.
    """

    name = "gust"
    lacks = {"same_in_every_frame": "the wind blows in a direction of the world"}
    group = "wind"
    power = 0
    # In T seconds frequencies differ that are 1 / T apart, and a fit reaches a third of that: enough for 3 seconds.
    further = {"frequency": tuple(0.2 * k for k in range(2, 21))}
    parameters = {
        "cosine": Parameter((0.6, 0.0, 0.6), "Pa", -1e3, 1e3, doc="amplitude of the part in phase with the start"),
        "sine": Parameter((0.6, 0.0, 0.6), "Pa", -1e3, 1e3, doc="amplitude of the part a quarter period later"),
        "frequency": Parameter(1.0, "1/s", 0.01, 15.0, linear=False, doc="swings per second"),
    }
    reference = "Simiu, Scanlan, Wind effects on structures, 1996, chapter 2 (one harmonic of a gusty wind)"

    def push(self, e: Elements, p: Values) -> Tensor:
        assert e.time is not None
        return swung({**p, **{name: uniform(p[name], e.x[0]) for name in ("cosine", "sine")}}, e.time)


def swung(p: Values, time: float | Tensor) -> Tensor:
    """The push [Pa] at a time [s], in the shape of its amplitudes."""
    clock = time if isinstance(time, Tensor) else torch.tensor(time, dtype=torch.float64)
    phase = 2 * pi * p["frequency"] * clock
    return p["cosine"] * torch.cos(phase) + p["sine"] * torch.sin(phase)
