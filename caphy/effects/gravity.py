"""Weight."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.conventions import GRAVITY
from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import dot


class Gravity(Effect):
    """Weight of the cloth, E = -m g.x [J]."""

    name = "gravity"
    element = "vertex"
    parameters = {"acceleration": Parameter(GRAVITY, "m/s^2", -100.0, 100.0, doc="acceleration of free fall")}
    reference = "Santesteban, Otaduy, Casas, SNUG, CVPR 2022, eq. 8"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"mass": cloth.mass}

    def energy(self, e: Elements, p: Values) -> Tensor:
        (x,) = e.x
        return -e.rest["mass"] * dot(p["acceleration"], x)
