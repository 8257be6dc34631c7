"""A uniform wind that pushes across the cloth with the square of the relative speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from caphy.effects.air import Air, squared
from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.vectors import uniform


class WindNormalQuadratic(Air):
    """Quadratic drag relative to a uniform wind w across the cloth, E = dt c A / 3 |(v - w).n|^3 [J] per face.

    The pressure is c |u| u with u = (v - w).n and c = 1/2 rho C_d. It is not linear in w: start from the wind that the
    linear law finds. It holds the cloth's drag through the moving air.
    """

    name = "wind_normal_quadratic"
    lacks = {"same_in_every_frame": "the wind blows in a direction of the world"}
    group = "wind"
    refines = "wind_normal"
    power = 2
    parameters = {
        "coefficient": Parameter(0.6, "kg/m^3", 0.0, 1e3, doc="pressure per squared speed, 1/2 rho C_d"),
        "velocity": Parameter((1.0, 0.0, 1.0), "m/s", -100.0, 100.0, linear=False, doc="velocity of the air"),
    }
    reference = "Hoerner, Fluid-dynamic drag, 1965, chapter 3 (drag of plates)"

    def start(self, found: Mapping[str, np.ndarray]) -> dict[str, Any]:
        return squared(found, self.parameters["coefficient"])

    def wind(self, e: Elements, p: Values) -> Tensor:
        return uniform(p["velocity"], e.x[0])
