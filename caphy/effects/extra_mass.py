"""Mass spread over the cloth: another density, or water."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.mass import Mass


class ExtraMass(Mass):
    """Area density added to the model's, E = sigma a (|x - target|^2 / (2 dt^2) - g.x) [J] per vertex.

    It has inertia and weight, as water in wet cloth has; a is the vertex's rest area. Negative values make the cloth
    lighter; the sum with the model's density must stay positive. It differs from stiffnesses all scaled alike only
    in how the cloth meets air and body.
    """

    name = "extra_mass"
    lacks = {"same_in_every_frame": "weight: the world has an up"}
    parameters = {"density": Parameter(0.05, "kg/m^2", -10.0, 10.0, doc="extra area density")}
    reference = "Newton 1687; for water in cloth: Huber, Pabst, Strasser, Wet cloth simulation, 2011"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"area": cloth.vertex_area}

    def mass(self, e: Elements, p: Values) -> Tensor:
        return p["density"] * e.rest["area"]
