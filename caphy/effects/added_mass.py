"""Air that the cloth carries along: inertia without weight."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import dot, isotropic


class AddedMass(Effect):
    """Inertia without weight, E = sigma a / (2 dt^2) |x - target|^2 [J] per vertex of rest area a.

    Air around a plate moves with it and buoys its own weight. It is taken alike in all directions, although a thin
    sheet carries air across itself only. The default is the air of a disk of 10 cm radius: 8 rho r / (3 pi).
    """

    name = "added_mass"
    element = "vertex"
    group = "mass"
    parameters = {"density": Parameter(0.1, "kg/m^2", 0.0, 10.0, doc="area density of the air that moves along")}
    reference = "Lamb, Hydrodynamics, 1932, section 102 (the disk)"
    needs_step = True

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"area": cloth.vertex_area}

    def energy(self, e: Elements, p: Values) -> Tensor:
        assert e.target is not None and e.dt is not None
        (offset,) = e.x - e.target
        return p["density"] * e.rest["area"] / (2 * e.dt**2) * dot(offset, offset)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        assert e.target is not None
        return self.energy(e, p), self._stiffness(e, p) * (e.x - e.target)

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Constant and positive semi-definite."""
        return isotropic(self._stiffness(e, p), e.x)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)

    def _stiffness(self, e: Elements, p: Values) -> Tensor:
        assert e.dt is not None
        return p["density"] * e.rest["area"] / e.dt**2
