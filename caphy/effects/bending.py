"""Resistance of the cloth to bending."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.hinge import Hinge, dihedral, dihedral_gradient, hinge_rest, turn


class Bending(Hinge):
    """Hinge bending, E = k l^2 / (8 A) (theta - theta_rest)^2 [J] per interior edge.

    l is the edge's rest length, A the rest area of its two faces, theta the signed dihedral angle, so that folds
    sewn or pressed into the template stay. On a cylinder of curvature kappa this is k kappa^2 / 8 per area, if
    triangles are equilateral or it bends along the threads of a grid: k is four times the flexural rigidity of plates.
    A strip with free sides bends across as well (equilateral triangles) or twists (a grid), and resists bending by 8/9
    or 4/5 of that. k follows the threads that bend: an edge at angle phi from the weft has k = weft sin(phi)^2 + warp
    cos(phi)^2, since the cloth bends across the edge. Default: SNUG's cotton.
    """

    name = "bending"
    group = "stiffness"
    parameters = {
        "stiffness_weft": Parameter(3.96e-5, "N m", 0.0, 1.0, doc="k where the weft threads bend"),
        "stiffness_warp": Parameter(3.96e-5, "N m", 0.0, 1.0, doc="k where the warp threads bend"),
    }
    reference = "CaPhy eq. 8; Grinspun et al., Discrete shells, SCA 2003; Bridson et al., SCA 2003"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        rest = hinge_rest(cloth)
        square = (cloth.hinge_edges**2).mean(1)
        scale = rest["length"] ** 2 / (8 * rest["area"]) / square.sum(-1)
        return {**rest, "weft": scale * square[:, 1], "warp": scale * square[:, 0]}

    def energy(self, e: Elements, p: Values) -> Tensor:
        return bending_stiffness(e.rest, p) * turn(dihedral(e.x), e.rest["angle"]) ** 2

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        angle, slope = dihedral_gradient(e.x, e.rest["length"], e.rest["area"])
        turned = turn(angle, e.rest["angle"])
        moment = bending_stiffness(e.rest, p) * turned
        return moment * turned, 2 * moment * slope

    def response(self, angle: Tensor, e: Elements, p: Values, convex: bool = False) -> tuple[Tensor, Tensor]:
        stiffness = 2 * bending_stiffness(e.rest, p)
        return stiffness * turn(angle, e.rest["angle"]), stiffness


def bending_stiffness(rest: Mapping[str, Tensor], p: Values) -> Tensor:
    """Energy per squared angle (n,) [J]."""
    return p["stiffness_weft"] * rest["weft"] + p["stiffness_warp"] * rest["warp"]
