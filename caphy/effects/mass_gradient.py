"""Cloth that is heavier below than above."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.mass import Mass


class MassGradient(Mass):
    """Area density that grows downwards, E = m (|x - target|^2 / (2 dt^2) - g.x) [J] per vertex.

    m = gamma a (h_mean - h) with h the vertex's height in the template (its y), a its rest area and h_mean the mean
    over the area, so that the total mass stays. A template without height has none of it. The density must stay
    positive everywhere, which is for the model to keep.
    """

    name = "mass_gradient"
    lacks = {"same_in_every_frame": "weight: the world has an up"}
    parameters = {"gradient": Parameter(0.2, "kg/m^3", -100.0, 100.0, doc="area density gained per metre downwards")}
    reference = "Newton, Philosophiae naturalis principia mathematica, 1687"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        height = cloth.vertices[:, 1]
        return {"moment": cloth.vertex_area * (np.average(height, weights=cloth.vertex_area) - height)}

    def mass(self, e: Elements, p: Values) -> Tensor:
        return p["gradient"] * e.rest["moment"]
