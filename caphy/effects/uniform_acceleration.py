"""A uniform acceleration besides gravity: a tilted floor or camera, a carriage that speeds up."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.laden import LOADS, laden_mass, laden_rest
from caphy.effects.vectors import dot, isotropic, uniform


class UniformAcceleration(Effect):
    """A force in proportion to mass, the same everywhere, E = -m a.x [J] per vertex.

    Gravity seen through axes tilted by an angle is an acceleration of g sin(angle) sideways; the default is 4.1
    degrees. m is the cloth's mass with the model's extra_mass, heavy_hem and mass_gradient, as gravity's is.
    """

    name = "uniform_acceleration"
    lacks = {"same_in_every_frame": "it has a direction of the world"}
    element = "vertex"
    group = "external"
    parameters = {
        "acceleration": Parameter((0.5, 0.0, 0.5), "m/s^2", -100.0, 100.0, doc="acceleration added to gravity")
    }
    reference = "d'Alembert, Traite de dynamique, 1743"
    heeds = LOADS

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return laden_rest(cloth)

    def energy(self, e: Elements, p: Values) -> Tensor:
        (x,) = e.x
        return -laden_mass(e, p) * dot(uniform(p["acceleration"], x), x)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        force = -laden_mass(e, p) * uniform(p["acceleration"], e.x[0])
        return self.energy(e, p), force.expand(e.x.shape)

    def hessian(self, e: Elements, p: Values) -> Tensor:
        return isotropic(torch.zeros_like(e.rest["mass"]), e.x)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)
