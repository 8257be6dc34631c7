"""Openings drawn together: elastic sewn in stretched, a drawstring."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.seams import per_loop, seams
from caphy.effects.vectors import dot


class SeamTension(Effect):
    """Tension along the openings, E = T / (2 l) |x_a - x_b|^2 [J] per edge of rest length l.

    It is the pull of elastic stretched to many times its own length: T at the opening's rest length and less in
    proportion as the opening is drawn together, smooth down to nothing. Values are for the four lowest openings,
    lowest first, as in heavy_hem. With seam_stiffness k the two are a band that rests at k / (k + T) of the opening.
    """

    name = "seam_tension"
    lacks = {"rests_at_rest": "it changes the shape that rests"}
    element = "edge"
    group = "rest shape"
    parameters = {"tension": Parameter((0.1, 0.0, 0.0, 0.0), "N", 0.0, 1e4, doc="force at rest length, lowest first")}
    separate = ("tension",)
    reference = "Hooke, De potentia restitutiva, 1678"
    internal = True

    def index(self, cloth: Cloth) -> np.ndarray:
        return seams(cloth)[0]

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        _, number, length = seams(cloth)
        return {"share": per_loop(number, 1 / length)}

    def energy(self, e: Elements, p: Values) -> Tensor:
        edge = e.x[1] - e.x[0]
        return 0.5 * (p["tension"] @ e.rest["share"]) * dot(edge, edge)
