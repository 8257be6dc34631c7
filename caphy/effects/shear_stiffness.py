"""Extra stiffness against shear of the threads."""

from __future__ import annotations

from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import Membrane, Symmetric


class ShearStiffness(Membrane):
    """Stiffness added against shear between weft and warp, E = A k / 2 (2 G_uv)^2 [J] per face.

    k is the shear modulus times thickness: StVK's mu. Negative values soften; the sum with the model's membrane must
    stay positive, which is for the model to keep.
    """

    name = "shear_stiffness"
    group = "stiffness"
    parameters = {"stiffness": Parameter(5.0, "N/m", -1e5, 1e5, doc="extra shear force per width and shear angle")}
    reference = "Wang, O'Brien, Ramamoorthi, Data-driven elastic models for cloth, SIGGRAPH 2011, section 3"

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        return 2 * p["stiffness"] * strain[2] * strain[2]
