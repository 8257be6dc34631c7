"""Shrinkage of the cloth along its weft and warp."""

from __future__ import annotations

from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.lending import OfMembrane
from caphy.effects.membrane import Symmetric
from caphy.effects.shrinkage import shrunk_density


class ShrinkageDirectional(OfMembrane):
    """A rest shape shorter by s_u along the weft and s_v along the warp [J] per face.

    E = A ((1 - s_u)(1 - s_v) psi(G') - psi(G)) with psi the model's own membrane and what stiffens it, and G' the
    strain from the smaller rest shape, as in shrinkage, which this is where both are the same. Negative values let the
    cloth grow. Beside shrinkage the fractions add to first order, where cutting twice would multiply what is left.
    """

    name = "shrinkage_directional"
    lacks = {"rests_at_rest": "it changes the shape that rests"}
    group = "rest shape"
    parameters = {
        "weft": Parameter(0.03, "1", -0.5, 0.5, linear=False, doc="share of lengths along the weft that is lost"),
        "warp": Parameter(0.03, "1", -0.5, 0.5, linear=False, doc="share of lengths along the warp that is lost"),
    }
    coefficients = ("weft", "warp")
    reference = "multiplicative split of eigenstrain: Lee, Elastic-plastic deformation at finite strains, 1969"

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        return shrunk_density(strain, 1 - p["weft"], 1 - p["warp"], e, p)
