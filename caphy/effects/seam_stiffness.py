"""Openings that resist stretch: tape, ribs, a waistband."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.seams import per_loop, seams
from caphy.effects.vectors import norm


class SeamStiffness(Effect):
    """Springs along the openings, E = k l / 2 (|x_a - x_b| / l - 1)^2 [J] per edge of rest length l.

    Values are for the four lowest openings, lowest first, as in heavy_hem. An elastic band sewn in stretched has a
    tension besides: seam_tension. The default is a band of 1 cm by 0.5 mm rubber of 2 MPa, at the lowest.
    """

    name = "seam_stiffness"
    element = "edge"
    group = "stiffness"
    parameters = {
        "stiffness": Parameter((10.0, 0.0, 0.0, 0.0), "N", 0.0, 1e6, doc="force per stretch, lowest opening first")
    }
    separate = ("stiffness",)
    reference = "Hooke, De potentia restitutiva, 1678"
    internal = True

    def index(self, cloth: Cloth) -> np.ndarray:
        return seams(cloth)[0]

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        _, number, length = seams(cloth)
        return {"length": length, "share": per_loop(number, length)}

    def energy(self, e: Elements, p: Values) -> Tensor:
        stretch = norm(e.x[1] - e.x[0]) / e.rest["length"] - 1
        return 0.5 * (p["stiffness"] @ e.rest["share"]) * stretch * stretch
