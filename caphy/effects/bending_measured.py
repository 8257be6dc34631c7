"""Bending of the measured fabrics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.hinge import Hinge, dihedral, dihedral_gradient, hinge_rest, turn
from caphy.material.fabrics import BEND_SPACING, fabric


class BendingMeasured(Hinge):
    """Hinge bending with measured stiffness: moment k l^2 / (4 A) (theta - theta_rest) [N m], E [J] its integral.

    k is linear in the edge's angle from the weft (rows at 0, 45 and 90 degrees) and in the curvature
    |theta - theta_rest| l / (2 A) (columns 0, 5, 10, 15, 20 1/m, constant beyond), never negative; of the two
    triangles' the smaller counts, at each tabulated curvature. The integral is exact, so the force is the gradient of
    the energy; where k is constant it is CaPhy's k l^2 / (8 A) (theta - theta_rest)^2. Curvature counts from the
    template's, since the fabrics were measured flat at rest. The default is a knit, gray interlock.
    """

    name = "bending_measured"
    lacks = {"units_fit": "its table is measured at fixed curvatures in 1/m"}
    group = "stiffness"
    parameters = {
        "bending": Parameter(
            tuple(map(tuple, fabric("gray-interlock").bending.tolist())),
            "N m",
            -1.0,
            1.0,
            linear=False,
            doc="bending table: edges at 0, 45, 90 degrees from the weft by curvatures 0, 5, 10, 15, 20 1/m",
        )
    }
    reference = "Wang, O'Brien, Ramamoorthi, Data-driven elastic models for cloth, SIGGRAPH 2011; CaPhy eq. 8"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        u, v = np.abs(np.moveaxis(cloth.hinge_edges, -1, 0))
        row = np.arctan2(v, u) / (np.pi / 4)
        share = np.maximum(1 - np.abs(row - np.arange(3)[:, None, None]), 0)  # hat functions of the rows, (3, H, 2)
        return {**hinge_rest(cloth), "first": share[..., 0], "second": share[..., 1]}

    def energy(self, e: Elements, p: Values) -> Tensor:
        return measured_moments(turn(dihedral(e.x), e.rest["angle"]), e.rest, p)[0]

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        angle, slope = dihedral_gradient(e.x, e.rest["length"], e.rest["area"])
        energy, moment = measured_moments(turn(angle, e.rest["angle"]), e.rest, p)
        return energy, moment * slope

    def response(self, angle: Tensor, e: Elements, p: Values, convex: bool = False) -> tuple[Tensor, Tensor]:
        """With ``convex`` a moment grows at least in proportion."""
        turned = turn(angle, e.rest["angle"])
        _, secant, tangent = _moments(_column(turned, e.rest), stiffness_nodes(e.rest, p))
        scale = e.rest["length"] ** 2 / (4 * e.rest["area"])
        return scale * secant * turned, scale * (torch.maximum(tangent, secant) if convex else tangent)


def measured_moments(turned: Tensor, rest: Mapping[str, Tensor], p: Values) -> tuple[Tensor, Tensor]:
    """Energy (..., n) [J] of hinges turned from their rest angles (..., n) [rad], and its derivative [N m]."""
    energy, stiffness, _ = _moments(_column(turned, rest), stiffness_nodes(rest, p))
    return BEND_SPACING**2 * rest["area"] * energy, stiffness * rest["length"] ** 2 / (4 * rest["area"]) * turned


def _column(turned: Tensor, rest: Mapping[str, Tensor]) -> Tensor:
    """Place (..., n) among the tabulated curvatures, in columns."""
    return turned.abs() * (rest["length"] / (2 * BEND_SPACING * rest["area"]))


def stiffness_nodes(rest: Mapping[str, Tensor], p: Values) -> Tensor:
    """Stiffness of each hinge at the five tabulated curvatures (5, n) [N m]."""
    table = p["bending"].T
    return torch.minimum(table @ rest["first"], table @ rest["second"]).clamp_min(0)


def _moments(column: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """int_0^y k(t) t dt, k(y) and d(k y)/dy at columns y (..., n), for k linear between nodes (5, n)."""
    k = slope = nodes[0].expand_as(column)
    integral = 0.5 * nodes[0] * column * column
    rise = torch.zeros_like(nodes[0])
    for place in range(5):
        following = nodes[place + 1] - nodes[place] if place < 4 else torch.zeros_like(rise)
        bend, rise = following - rise, following
        beyond = (column - place).clamp_min(0)
        integral = integral + bend * beyond * beyond * (beyond / 3 + 0.5 * place)
        k = k + bend * beyond
        slope = slope + bend * torch.where(beyond > 0, column + beyond, torch.zeros_like(beyond))
    return integral, k, slope
