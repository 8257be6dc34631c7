"""Drag of still air across the cloth, growing with the square of speed."""

from __future__ import annotations

from caphy.effects.air import Air
from caphy.effects.base import Parameter


class AirDragNormalQuadratic(Air):
    """Quadratic drag against motion along the normal, E = dt c A / 3 |v.n|^3 [J] per face.

    The force is -c A |v.n| (v.n) n with c = 1/2 rho C_d; the default is that of air and a plate of C_d = 1.
    """

    name = "air_drag_normal_quadratic"
    group = "drag"
    power = 2
    parameters = {"coefficient": Parameter(0.6, "kg/m^3", 0.0, 1e3, doc="pressure per squared speed, 1/2 rho C_d")}
    reference = "Hoerner, Fluid-dynamic drag, 1965, chapter 3 (drag of plates)"
