"""Internal friction of the threads: the cloth gives back less than it took."""

from __future__ import annotations

import torch
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import (
    Deformation,
    Membrane,
    Symmetric,
    Tangent,
    membrane_gradient,
    positive_part,
    square,
    strained,
)


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

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        assert e.dt is not None
        return e.dt * p["friction"] * (_size(strained(strain, e), p) - p["slip"])

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        deformation = Deformation.of(e)
        energy = e.rest["area"] * self.density(deformation.strain, e, p)
        return energy, membrane_gradient(e, deformation, _stress(strained(deformation.strain, e), p))

    def response(self, strain: Symmetric, e: Elements, p: Values, convex: bool = False) -> tuple[Symmetric, Tangent]:
        """Semi-definite as it stands: friction against a rate is the less, the faster it is already."""
        assert e.dt is not None
        rate = uu, vv, uv = strained(strain, e)
        size, stress = _size(rate, p), _stress(rate, p)
        stiff, turned = p["friction"] / (e.dt * size), 1 / (size * size)
        tangent = (
            stiff * (1 - uu * uu * turned),
            stiff * (1 - vv * vv * turned),
            stiff * (0.5 - uv * uv * turned),
            -stiff * uu * vv * turned,
            -stiff * uu * uv * turned,
            -stiff * vv * uv * turned,
        )
        return positive_part(stress) if convex else stress, tangent


def _size(rate: Symmetric, p: Values) -> Tensor:
    """Of a rate of strain (..., n) [1/s], smoothed."""
    return torch.sqrt(square(rate) + p["slip"] ** 2)


def _stress(rate: Symmetric, p: Values) -> Symmetric:
    uu, vv, uv = rate
    friction = p["friction"] / _size(rate, p)
    return friction * uu, friction * vv, friction * uv
