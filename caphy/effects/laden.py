"""The mass of cloth with what else of its model has weight, for effects in proportion to mass."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Elements, Values, lent
from caphy.effects.cloth import Cloth
from caphy.effects.extra_mass import ExtraMass
from caphy.effects.heavy_hem import HeavyHem
from caphy.effects.mass import Mass
from caphy.effects.mass_gradient import MassGradient
from caphy.effects.seams import LOOPS

_LOADS: tuple[Mass, ...] = (ExtraMass(), HeavyHem(), MassGradient())
LOADS = tuple(load.name for load in _LOADS)
"""Effects whose mass counts where a model has them; not the air of added_mass, which has no weight."""


def laden_rest(cloth: Cloth) -> dict[str, np.ndarray]:
    """Rest constants of vertices that :func:`laden_mass` reads."""
    length = np.zeros((LOOPS, len(cloth.vertices)))
    try:
        corners = HeavyHem().index(cloth)[:, 0]
        np.add.at(length.T, corners, HeavyHem().rest(cloth)["length"].T)
    except ValueError:
        pass  # a mesh whose boundary is pinched has no openings; heavy_hem itself refuses it
    return {"mass": cloth.mass, "length": length, **ExtraMass().rest(cloth), **MassGradient().rest(cloth)}


def laden_mass(e: Elements, p: Values) -> Tensor:
    """Mass of each vertex (n,) [kg], of the cloth and of the loads that lend their parameters."""
    mass = e.rest["mass"]
    for load in _LOADS:
        if values := lent(p, load.name):
            mass = mass + load.mass(e, values)
    return mass
