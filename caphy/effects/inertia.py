"""Inertia as the incremental potential of implicit integration."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Effect, Elements, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import dot


class Inertia(Effect):
    """Inertia, E = m / (2 dt^2) |x - target|^2 [J]; implicit Euler's target is 2 x(t-1) - x(t-2)."""

    name = "inertia"
    element = "vertex"
    reference = "Martin et al., Example-based elastic materials, SIGGRAPH 2011, eq. 5; SNUG, CVPR 2022, eq. 9"
    needs_step = True

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"mass": cloth.mass}

    def energy(self, e: Elements, p: Values) -> Tensor:
        assert e.target is not None and e.dt is not None
        (offset,) = e.x - e.target
        return e.rest["mass"] / (2 * e.dt**2) * dot(offset, offset)
