"""Stiffening of the cloth as it is stretched."""

from __future__ import annotations

from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import Membrane, Symmetric, square


class StrainStiffening(Membrane):
    """Membrane energy of fourth order, E = A k / 4 tr(G^2)^2 [J] per face.

    The stress k tr(G^2) G is of third order in strain: nothing at first, and at a strain g as much as a stiffness of
    k g^2. The default adds 10 N/m at 10 %. It holds in all directions alike.
    """

    name = "strain_stiffening"
    group = "stiffness"
    parameters = {"stiffness": Parameter(1000.0, "N/m", 0.0, 1e8, doc="tension per cubed strain")}
    reference = "Fung, Biomechanics, 1993, section 7 (stiffening membranes), to the first order beyond StVK"

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        return 0.25 * p["stiffness"] * square(strain) ** 2
