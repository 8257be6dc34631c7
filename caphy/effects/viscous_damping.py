"""Viscous damping of stretch and shear."""

from __future__ import annotations

from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import Membrane, Symmetric, square, strain_of


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

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        assert e.origin is not None and e.dt is not None
        uu, vv, uv = (now - then for now, then in zip(strain, strain_of(e, e.origin), strict=True))
        return p["viscosity"] / (2 * e.dt) * square((uu, vv, uv))
