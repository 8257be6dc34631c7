"""Extra stiffness of the cloth against bending."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.hinge import Hinge, turn


class ExtraBending(Hinge):
    """Bending stiffness added in all directions, E = k l^2 / (8 A) (theta - theta_rest)^2 [J] per interior edge.

    k is as bending's, four times the flexural rigidity of plate theory on a cylinder; a strip with free sides resists
    bending by 8/9 or 4/5 of that. Negative values soften; the sum with the model's bending must stay positive, which is
    for the model to keep.
    """

    name = "extra_bending"
    group = "stiffness"
    parameters = {"stiffness": Parameter(4e-5, "N m", -1.0, 1.0, doc="extra k in all directions")}
    reference = "CaPhy eq. 8; Grinspun et al., Discrete shells, SCA 2003"

    def bent(self, angle: Tensor, e: Elements, p: Values) -> Tensor:
        return extra_stiffness(e.rest, p) * turn(angle, e.rest["angle"]) ** 2


def extra_stiffness(rest: Mapping[str, Tensor], p: Values) -> Tensor:
    """Energy per squared angle (n,) [J]."""
    return p["stiffness"] * rest["length"] ** 2 / (8 * rest["area"])
