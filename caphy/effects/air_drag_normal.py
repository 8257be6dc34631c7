"""Drag of still air across the cloth, growing linearly with speed."""

from __future__ import annotations

from caphy.effects.air import Air
from caphy.effects.base import Parameter


class AirDragNormal(Air):
    """Linear drag against motion along the normal, E = dt c A / 2 (v.n)^2 [J] per face.

    A is the face's rest area, v the mean velocity of its corners, n its normal at the last converged state. The force
    is -c A (v.n) n, shared by the corners. The default is the slope of 1/2 rho C_d v^2 at 1 m/s in air.
    """

    name = "air_drag_normal"
    group = "drag"
    parameters = {"coefficient": Parameter(1.2, "N s/m^3", 0.0, 1e3, doc="pressure per speed")}
    reference = "Baraff, Witkin, Large steps in cloth simulation, SIGGRAPH 1998, section 4.4 (wind drag)"
