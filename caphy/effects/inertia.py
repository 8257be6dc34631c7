"""Inertia as the incremental potential of implicit integration."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Effect, Elements, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import dot, isotropic


class Inertia(Effect):
    """Inertia, E = m / (2 dt^2) |x - target|^2 [J]; implicit Euler's target is 2 x(t-1) - x(t-2)."""

    name = "inertia"
    element = "vertex"
    group = "mass"
    reference = "Martin et al., Example-based elastic materials, SIGGRAPH 2011, eq. 5; SNUG, CVPR 2022, eq. 9"
    needs_step = True

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"mass": cloth.mass}

    def energy(self, e: Elements, p: Values) -> Tensor:
        assert e.target is not None and e.dt is not None
        (offset,) = e.x - e.target
        return e.rest["mass"] / (2 * e.dt**2) * dot(offset, offset)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        assert e.target is not None and e.dt is not None
        offset = e.x - e.target
        force = e.rest["mass"] / e.dt**2 * offset
        return 0.5 * dot(force[0], offset[0]), force

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Constant and positive definite."""
        assert e.dt is not None
        return isotropic(e.rest["mass"] / e.dt**2, e.x)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)
