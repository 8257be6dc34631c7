"""Air pressure from within."""

from __future__ import annotations

from torch import Tensor

from caphy.effects.air import lagged_area
from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.vectors import dot


class Pressure(Effect):
    """Pressure on the inner side of every face, E = -p a.(x - x_lagged) [J] with a its lagged area vector.

    The force p A n is shared by the corners and follows the cloth one step behind, which also holds where the garment
    is open and no volume exists. Positive pressure pushes along the normal, outwards.
    """

    name = "pressure"
    element = "face"
    group = "external"
    parameters = {"pressure": Parameter(1.0, "Pa", -1e5, 1e5, doc="pressure inside less outside")}
    reference = "Landau, Lifshitz, Fluid mechanics, 1987, section 2"
    needs_step = True

    def energy(self, e: Elements, p: Values) -> Tensor:
        assert e.lagged is not None
        return -p["pressure"] * dot(lagged_area(e), (e.x - e.lagged).mean(0))
