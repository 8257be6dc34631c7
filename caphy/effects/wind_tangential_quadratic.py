"""A uniform wind that pulls along the cloth with the square of the relative speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from caphy.effects.air import Air, squared
from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.vectors import uniform


class WindTangentialQuadratic(Air):
    """Quadratic skin friction relative to a uniform wind w, E = dt c A / 3 |u|^3 [J] per face.

    u is the part of v - w along the cloth and c = rho C_f of both sides. It is not linear in w: start from the wind
    that the linear law finds. It holds the cloth's skin friction in the moving air.
    """

    name = "wind_tangential_quadratic"
    lacks = {"same_in_every_frame": "the wind blows in a direction of the world"}
    group = "wind"
    refines = "wind_tangential"
    across = False
    power = 2
    parameters = {
        "coefficient": Parameter(0.03, "kg/m^3", 0.0, 1e3, doc="shear stress per squared speed, both sides"),
        "velocity": Parameter((1.0, 0.0, 1.0), "m/s", -100.0, 100.0, linear=False, doc="velocity of the air"),
    }
    reference = "Schlichting, Boundary-layer theory, 1979, chapter 21 (rough plates)"

    def start(self, found: Mapping[str, np.ndarray]) -> dict[str, Any]:
        return squared(found, self.parameters["coefficient"])

    def wind(self, e: Elements, p: Values) -> Tensor:
        return uniform(p["velocity"], e.x[0])
