"""Softening of cloth that was stretched before."""

from __future__ import annotations

import torch
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.lending import OfMembrane, membrane_density
from caphy.effects.membrane import Symmetric


class Softening(OfMembrane):
    """Less tension below the stretch that was reached before, E = -A s (W - W^2 / (2 W_m)) [J] per face, W < W_m.

    W is the energy per area of the model's own membrane, with whatever else stiffens it in its plane by a law of the
    strain alone, and W_m the largest it ever had. The stress is (1 - s (1 - W / W_m)) of the first loading's: least at
    rest, all of it from W_m on, where E stays -A s W_m / 2. This is the pseudo-elasticity of the Mullins effect with
    the simplest law, of cloth whose largest earlier stretch is known, as in repeated tensile tests and after wear.
    """

    name = "softening"
    lacks = {"projection_is_semidefinite": "it takes tension away: where cloth is taut its Hessian is negative"}
    group = "stiffness"
    parameters = {
        "share": Parameter(0.2, "1", -1.0, 1.0, doc="share of the tension at rest that the first stretch took away"),
        "reach": Parameter(50.0, "N/m", 1e-3, 1e6, linear=False, doc="W_m, largest energy per area so far"),
    }
    reference = "Ogden, Roxburgh, A pseudo-elastic model for the Mullins effect in filled rubber, 1999, section 3"

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        first = membrane_density(strain, e, p)
        below = torch.clamp(first, max=p["reach"])
        return -p["share"] * (below - 0.5 * below * below / p["reach"])
