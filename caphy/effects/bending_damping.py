"""Viscous damping of bending."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.hinge import Hinge, dihedral, dihedral_gradient, turn


class BendingDamping(Hinge):
    """Resistance to the rate of bending, E = dt c l^2 / (8 A) (dtheta/dt)^2 [J] per interior edge.

    dtheta/dt is the change of the dihedral angle over the step, which no rigid motion makes; l and A are the edge's
    length and the area of its faces at rest. c relates to bending's stiffness k as a time: the default is 25 ms
    of SNUG's cotton.
    """

    name = "bending_damping"
    group = "damping"
    parameters = {"viscosity": Parameter(1e-6, "N m s", 0.0, 1.0, doc="bending stiffness times relaxation time")}
    reference = "Grinspun et al., Discrete shells, SCA 2003, section 4 (rate of the hinge angle)"
    needs_step = True

    def bent(self, angle: Tensor, e: Elements, p: Values) -> Tensor:
        assert e.dt is not None
        return damping_stiffness(e.rest, p, e.dt) * turn(angle, _then(e)) ** 2

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        angle, slope = dihedral_gradient(e.x, e.rest["length"], e.rest["area"])
        moment, _ = self.response(angle, e, p)
        return 0.5 * moment * turn(angle, _then(e)), moment * slope

    def response(self, angle: Tensor, e: Elements, p: Values, convex: bool = False) -> tuple[Tensor, Tensor]:
        """Moment [N m] and its slope [N m] at angles (..., n) [rad], in closed form."""
        assert e.dt is not None
        slope = 2 * damping_stiffness(e.rest, p, e.dt)
        return slope * turn(angle, _then(e)), slope


def _then(e: Elements) -> Tensor:
    """Angles (..., n) [rad] from which the change over the step is counted."""
    return e.then("dihedral angle", dihedral, turn)


def damping_stiffness(rest: Mapping[str, Tensor], p: Values, dt: float) -> Tensor:
    """c l^2 / (8 A dt) [N m] of each hinge (n,): the energy is that times the squared change of angle."""
    return p["viscosity"] * rest["length"] ** 2 / (8 * rest["area"] * dt)
