"""Damping in proportion to mass."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.laden import LOADS, laden_mass, laden_rest
from caphy.effects.vectors import dot, isotropic


class MassDamping(Effect):
    """Resistance to all motion in proportion to mass, E = dt c m / 2 |v|^2 [J] per vertex.

    Free motion decays at the rate c, the same for every mode; falling cloth ends at g / c. It stands for air that
    resists all directions alike, measured from still air. m is the cloth's mass with the model's extra_mass, heavy_hem
    and mass_gradient; air that moves along (added_mass) is not counted, and slows the decay.
    """

    name = "mass_damping"
    element = "vertex"
    group = "damping"
    parameters = {"rate": Parameter(1.0, "1/s", 0.0, 1e3, doc="rate at which velocities decay")}
    reference = "Rayleigh, The theory of sound, 1877, section 81 (the mass-proportional part of his damping)"
    needs_step = True
    heeds = LOADS

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return laden_rest(cloth)

    def energy(self, e: Elements, p: Values) -> Tensor:
        assert e.dt is not None
        (velocity,) = e.velocity
        return 0.5 * e.dt * p["rate"] * laden_mass(e, p) * dot(velocity, velocity)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        return self.energy(e, p), p["rate"] * laden_mass(e, p) * e.velocity

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Constant, and positive semi-definite where the mass is."""
        assert e.dt is not None
        return isotropic(p["rate"] * laden_mass(e, p) / e.dt, e.x)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        assert e.dt is not None
        return isotropic(p["rate"] * laden_mass(e, p).clamp_min(0) / e.dt, e.x)
