"""Hems, cuffs and bands that weigh more than the cloth."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.mass import Mass
from caphy.effects.seams import per_loop, seams


class HeavyHem(Mass):
    """Mass along the openings, E = m (|x - target|^2 / (2 dt^2) - g.x) [J] per vertex of an opening.

    m is the line density of the opening times half the rest length of its two edges there. Values are for the four
    lowest openings, lowest first (the hem of a T-shirt, then cuffs from the wearer's left, then the neck). The default
    is a threefold hem 1 cm wide of 0.2 kg/m^2 at the lowest.
    """

    name = "heavy_hem"
    lacks = {"same_in_every_frame": "weight: the world has an up"}
    parameters = {
        "line_density": Parameter((0.004, 0.0, 0.0, 0.0), "kg/m", 0.0, 10.0, doc="extra mass, lowest opening first")
    }
    separate = ("line_density",)
    reference = "Newton, Philosophiae naturalis principia mathematica, 1687"

    def index(self, cloth: Cloth) -> np.ndarray:
        ends, _, _ = seams(cloth)
        return ends.reshape(-1, 1)

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        _, number, length = seams(cloth)
        return {"length": per_loop(np.repeat(number, 2), np.repeat(length, 2) / 2)}

    def mass(self, e: Elements, p: Values) -> Tensor:
        return p["line_density"] @ e.rest["length"]
