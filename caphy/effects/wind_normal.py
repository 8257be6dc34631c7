"""A uniform wind that pushes across the cloth, and the linear drag of its air."""

from __future__ import annotations

from torch import Tensor

from caphy.effects.air import Air
from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.vectors import uniform


class WindNormal(Air):
    """Linear drag relative to a uniform wind across the cloth, E = dt A (c / 2 |u|^2 - f.u) [J] per face.

    u = (v.n) n is the cloth's own motion and f / c the wind's velocity w: with f = c w the energy is
    c / 2 |((v - w).n) n|^2 but for a constant. Written with the push f it is linear in all coefficients and can be
    found from nothing. It holds the cloth's drag through the moving air, so that a model that has
    air_drag_normal already gets that much more drag.
    """

    name = "wind_normal"
    lacks = {"same_in_every_frame": "the wind blows in a direction of the world"}
    group = "wind"
    parameters = {
        "coefficient": Parameter(1.2, "N s/m^3", 0.0, 1e3, doc="pressure per speed"),
        "push": Parameter(
            (1.2, 0.0, 1.2),
            "Pa",
            -1e3,
            1e3,
            doc="pressure on resting cloth; wind velocity times coefficient",
        ),
    }
    reference = "Baraff, Witkin, Large steps in cloth simulation, SIGGRAPH 1998, section 4.4 (wind drag)"

    def push(self, e: Elements, p: Values) -> Tensor:
        return uniform(p["push"], e.x[0])
