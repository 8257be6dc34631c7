"""Drag of still air along the cloth, growing with the square of speed."""

from __future__ import annotations

from caphy.effects.air import Air
from caphy.effects.base import Parameter


class AirDragTangentialQuadratic(Air):
    """Quadratic skin friction of air, E = dt c A / 3 |u|^3 [J] per face with u = v - (v.n) n.

    The force is -c A |u| u with c = rho C_f, both sides of the cloth together. The default is C_f = 0.025.
    """

    name = "air_drag_tangential_quadratic"
    group = "drag"
    across = False
    power = 2
    parameters = {"coefficient": Parameter(0.03, "kg/m^3", 0.0, 1e3, doc="shear stress per squared speed, both sides")}
    reference = "Schlichting, Boundary-layer theory, 1979, chapter 21 (rough plates)"
