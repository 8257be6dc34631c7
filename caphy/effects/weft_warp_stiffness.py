"""Extra stiffness of weft and warp threads."""

from __future__ import annotations

from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import Membrane, Symmetric


class WeftWarpStiffness(Membrane):
    """Stiffness added to the threads of each direction, E = A / 2 (k_u G_uu^2 + k_v G_vv^2) [J] per face.

    G_uu is the Green strain along the weft, G_vv along the warp. Negative values soften; the sum with the model's
    membrane must stay positive, which is for the model to keep.
    """

    name = "weft_warp_stiffness"
    group = "stiffness"
    parameters = {
        "weft": Parameter(10.0, "N/m", -1e5, 1e5, doc="extra tension per strain along the weft"),
        "warp": Parameter(10.0, "N/m", -1e5, 1e5, doc="extra tension per strain along the warp"),
    }
    reference = "Wang, O'Brien, Ramamoorthi, Data-driven elastic models for cloth, SIGGRAPH 2011, section 3"

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        uu, vv, _ = strain
        return 0.5 * (p["weft"] * uu * uu + p["warp"] * vv * vv)
