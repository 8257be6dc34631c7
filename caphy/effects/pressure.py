"""Air pressure from within."""

from __future__ import annotations

import torch
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

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        force = -p["pressure"] / 3 * lagged_area(e)
        return self.energy(e, p), force.expand(e.x.shape)

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Zero: the force is that of the lagged shape."""
        return torch.zeros_like(e.x).expand(3, 3, *e.x.shape)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)
