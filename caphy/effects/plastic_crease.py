"""Creases that stay: folds that open with less moment than it took to close them."""

from __future__ import annotations

import torch
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.hinge import dihedral, turn
from caphy.effects.lending import OfBending, bending_moment, bending_rest


class PlasticCrease(OfBending):
    """Friction of folds, E = dt r |M| A / l (sqrt(kappa'^2 + s^2) - s) [J] per interior edge.

    M is the elastic moment of the model's own bending, with whatever else stiffens its folds by a law of the angle
    alone, at the last converged state and kappa' = l / A dtheta/dt the rate of curvature. Closing a fold takes (1 + r)
    of the elastic moment, opening it gives back (1 - r): the cloth recovers only that share, and at r = 1 no fold opens
    by itself. Below the rate s friction fades into viscosity, so that the potential is smooth and creases smooth out at
    rates below s. What stays is held by friction, not by a memory of its own: a crease ironed flat is gone.
    """

    name = "plastic_crease"
    lacks = {"projection_is_semidefinite": "a constant or negative moment has a Gauss-Newton Hessian of zero"}
    group = "damping"
    parameters = {
        "share": Parameter(0.3, "1", 0.0, 2.0, doc="friction over the elastic moment: one less crease recovery"),
        "slip": Parameter(1.0, "1/(m s)", 1e-3, 1e3, linear=False, doc="rate of curvature below which friction fades"),
    }
    reference = "Miguel et al., Modeling and estimation of internal friction in cloth, SIGGRAPH Asia 2013; ISO 2313"
    needs_step = True

    def rest(self, cloth: Cloth) -> dict:
        return bending_rest(cloth)

    def bent(self, angle: Tensor, e: Elements, p: Values) -> Tensor:
        assert e.lagged is not None and e.dt is not None
        moment = bending_moment(turn(dihedral(e.lagged), e.rest["angle"]), e, p).abs()
        width = e.rest["area"] / e.rest["length"]
        rate = turn(angle, e.then("dihedral angle", dihedral, turn)) / (e.dt * width)
        return e.dt * p["share"] * moment * width * (torch.sqrt(rate * rate + p["slip"] ** 2) - p["slip"])
