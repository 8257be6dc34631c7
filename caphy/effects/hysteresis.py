"""Internal friction of the threads: the cloth gives back less than it took."""

from __future__ import annotations

import torch
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import Membrane, Symmetric, Tangent, square, strain_rate


class Hysteresis(Membrane):
    """Dry friction against stretch and shear, E = dt A tau (sqrt(tr((dG/dt)^2) + s^2) - s) [J] per face.

    dG/dt is the change of the Green strain over the step. Friction adds a stress of size tau whatever the speed,
    against the motion: loading needs tau more, unloading gives tau less. Below the rate s it fades into viscosity, so
    that the potential is smooth and cloth held stretched creeps at rates below s.
    """

    name = "hysteresis"
    group = "damping"
    parameters = {
        "friction": Parameter(0.5, "N/m", 0.0, 1e3, doc="tension of friction, half the width of the loop"),
        "slip": Parameter(0.05, "1/s", 1e-5, 10.0, linear=False, doc="rate of strain below which friction fades"),
    }
    reference = "Miguel et al., Modeling and estimation of internal friction in cloth, SIGGRAPH Asia 2013"
    needs_step = True
    semidefinite = True  # against a rate friction is the less, the faster it is already, and never turns round

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        assert e.dt is not None
        return e.dt * p["friction"] * (_size(strain_rate(strain, e), p) - p["slip"])

    def _stressed(self, strain: Symmetric, e: Elements, p: Values) -> tuple[Tensor, Symmetric]:
        assert e.dt is not None
        rate = uu, vv, uv = strain_rate(strain, e)
        size = _size(rate, p)
        friction = p["friction"] / size
        return e.dt * p["friction"] * (size - p["slip"]), (friction * uu, friction * vv, friction * uv)

    def _responded(self, strain: Symmetric, e: Elements, p: Values) -> tuple[Symmetric, Tangent]:
        assert e.dt is not None
        rate = uu, vv, uv = strain_rate(strain, e)
        size = _size(rate, p)
        friction = p["friction"] / size
        stiff, turned = friction / e.dt, 1 / (size * size)
        tangent = (
            stiff * (1 - uu * uu * turned),
            stiff * (1 - vv * vv * turned),
            stiff * (0.5 - uv * uv * turned),
            -stiff * uu * vv * turned,
            -stiff * uu * uv * turned,
            -stiff * vv * uv * turned,
        )
        return (friction * uu, friction * vv, friction * uv), tangent


def _size(rate: Symmetric, p: Values) -> Tensor:
    """Of a rate of strain (..., n) [1/s], smoothed."""
    return torch.sqrt(square(rate) + p["slip"] ** 2)
