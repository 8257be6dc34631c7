"""Internal friction of the threads: the cloth gives back less than it took."""

from __future__ import annotations

import torch
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import Membrane, Symmetric, square, strain_of


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
        assert e.origin is not None and e.dt is not None
        uu, vv, uv = ((now - then) / e.dt for now, then in zip(strain, strain_of(e, e.origin), strict=True))
        rate = torch.sqrt(square((uu, vv, uv)) + p["slip"] ** 2)
        return e.dt * p["friction"] * (rate - p["slip"])
