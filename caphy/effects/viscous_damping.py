"""Viscous damping of stretch and shear."""

from __future__ import annotations

import torch
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import Membrane, Symmetric, Tangent, square, strain_rate


class ViscousDamping(Membrane):
    """Resistance to the rate of strain (Kelvin-Voigt), E = dt A eta / 2 tr((dG/dt)^2) [J] per face.

    dG/dt is the change of the Green strain over the step, which no rigid motion makes. The stress is eta dG/dt; the
    default relaxes a cloth of 20 N/m in 5 ms. A model with it damps high modes first.
    """

    name = "viscous_damping"
    group = "damping"
    parameters = {"viscosity": Parameter(0.1, "N s/m", 0.0, 1e3, doc="tension per rate of strain")}
    reference = "Kharevych et al., Geometric, variational integrators for computer animation, SCA 2006, section 5"
    needs_step = True
    semidefinite = True

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        assert e.dt is not None
        return 0.5 * e.dt * p["viscosity"] * square(strain_rate(strain, e))

    def _stressed(self, strain: Symmetric, e: Elements, p: Values) -> tuple[Tensor, Symmetric]:
        return self.density(strain, e, p), _stress(strain, e, p)

    def _responded(self, strain: Symmetric, e: Elements, p: Values) -> tuple[Symmetric, Tangent]:
        assert e.dt is not None
        zero = torch.zeros_like(strain[0])
        direct = zero + p["viscosity"] / e.dt
        return _stress(strain, e, p), (direct, direct, 0.5 * direct, zero, zero, zero)


def _stress(strain: Symmetric, e: Elements, p: Values) -> Symmetric:
    uu, vv, uv = strain_rate(strain, e)
    return p["viscosity"] * uu, p["viscosity"] * vv, p["viscosity"] * uv
