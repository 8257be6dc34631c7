"""Drag of still air along the cloth, growing linearly with speed."""

from __future__ import annotations

from caphy.effects.air import Air
from caphy.effects.base import Parameter


class AirDragTangential(Air):
    """Linear skin friction of air against motion along the cloth, E = dt c A / 2 |v - (v.n) n|^2 [J] per face.

    The default, a twentieth of the drag across, stands for both sides of a rough cloth.
    """

    name = "air_drag_tangential"
    group = "drag"
    across = False
    parameters = {"coefficient": Parameter(0.06, "N s/m^3", 0.0, 1e3, doc="shear stress per speed, both sides")}
    reference = "Schlichting, Boundary-layer theory, 1979, chapter 21 (rough plates)"
