"""Openings drawn together: elastic sewn in stretched, a drawstring."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.seams import per_loop, seams
from caphy.effects.vectors import norm


class SeamTension(Effect):
    """Constant tension along the openings, E = T |x_a - x_b| [J] per edge.

    Values are for the four lowest openings, lowest first, as in heavy_hem. With seam_stiffness k it is an elastic
    band whose rest length is (1 - T / k) of the opening's.
    """

    name = "seam_tension"
    element = "edge"
    group = "rest shape"
    parameters = {"tension": Parameter((0.5, 0.0, 0.0, 0.0), "N", 0.0, 1e4, doc="force, lowest opening first")}
    reference = "Hooke, De potentia restitutiva, 1678, to zeroth order in the stretch"
    internal = True

    def index(self, cloth: Cloth) -> np.ndarray:
        return seams(cloth)[0]

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        _, number, length = seams(cloth)
        return {"on": per_loop(number, np.ones_like(length))}

    def energy(self, e: Elements, p: Values) -> Tensor:
        return (p["tension"] @ e.rest["on"]) * norm(e.x[1] - e.x[0])
