"""Difference of the bending stiffness of weft and warp threads."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.bending import Bending
from caphy.effects.cloth import Cloth
from caphy.effects.hinge import Hinge, turn


class BendingAnisotropy(Hinge):
    """Stiffness k where the weft bends and -k where the warp bends, added to the model's bending.

    E = k (sin^2 phi - cos^2 phi) l^2 / (8 A) (theta - theta_rest)^2 [J] per interior edge at an angle phi from the
    weft. The mean over directions stays. |k| must stay below the model's bending stiffness, which is for the model to
    keep.
    """

    name = "bending_anisotropy"
    lacks = {"projection_is_semidefinite": "a constant or negative moment has a Gauss-Newton Hessian of zero"}
    group = "stiffness"
    parameters = {"difference": Parameter(1e-5, "N m", -1.0, 1.0, doc="half of weft's k less warp's")}
    reference = "Wang, O'Brien, Ramamoorthi, Data-driven elastic models for cloth, SIGGRAPH 2011; CaPhy eq. 8"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return Bending().rest(cloth)

    def bent(self, angle: Tensor, e: Elements, p: Values) -> Tensor:
        return uneven_stiffness(e.rest, p) * turn(angle, e.rest["angle"]) ** 2


def uneven_stiffness(rest: Mapping[str, Tensor], p: Values) -> Tensor:
    """Energy per squared angle (n,) [J]."""
    return p["difference"] * (rest["weft"] - rest["warp"])
