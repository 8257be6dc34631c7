"""Weight."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caphy.conventions import GRAVITY
from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import dot, isotropic


class Gravity(Effect):
    """Weight of the cloth, E = -m g.x [J]."""

    name = "gravity"
    lacks = {"same_in_every_frame": "the world has an up"}
    element = "vertex"
    group = "external"
    parameters = {"acceleration": Parameter(GRAVITY, "m/s^2", -100.0, 100.0, doc="acceleration of free fall")}
    reference = "Santesteban, Otaduy, Casas, SNUG, CVPR 2022, eq. 8"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"mass": cloth.mass}

    def energy(self, e: Elements, p: Values) -> Tensor:
        (x,) = e.x
        return -e.rest["mass"] * dot(p["acceleration"], x)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        force = -p["acceleration"].reshape(3, *(1,) * (e.x.dim() - 2)) * e.rest["mass"]
        return self.energy(e, p), force.expand(e.x.shape)

    def hessian(self, e: Elements, p: Values) -> Tensor:
        return isotropic(torch.zeros_like(e.rest["mass"]), e.x)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)
