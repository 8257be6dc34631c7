"""Softening of cloth that was stretched before."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values, lent
from caphy.effects.lending import MEMBRANES, membrane_density
from caphy.effects.membrane import Membrane, Symmetric


class Softening(Membrane):
    """Less tension below the stretch that was reached before, E = -A s (W - W^2 / (2 W_m)) [J] per face, W < W_m.

    W is the energy per area of the model's own membrane, with whatever else stiffens it in its plane, and W_m the
    largest it ever had. The stress is (1 - s (1 - W / W_m)) of the first loading's: least at rest, all of it from W_m
    on, where E stays -A s W_m / 2. This is the pseudo-elasticity of the Mullins effect with the simplest law, of cloth
    whose largest earlier stretch is known, as in repeated tensile tests and after wear.
    """

    name = "softening"
    lacks = {"projection_is_semidefinite": "it takes tension away: where cloth is taut its Hessian is negative"}
    group = "stiffness"
    parameters = {
        "share": Parameter(0.2, "1", -1.0, 1.0, doc="share of the tension at rest that the first stretch took away"),
        "reach": Parameter(50.0, "N/m", 1e-3, 1e6, linear=False, doc="W_m, largest energy per area so far"),
    }
    reference = "Ogden, Roxburgh, A pseudo-elastic model for the Mullins effect in filled rubber, 1999, section 3"
    borrows = (MEMBRANES,)

    def lenders(self, present: Iterable[str]) -> tuple[str, ...] | None:
        """Its membrane, and whatever else stiffens the cloth in its plane."""
        names = set(present)
        needed = super().lenders(names)
        return None if needed is None else (*needed, *sorted(n for n in names - set(MEMBRANES) if _stiffens(n)))

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        first = membrane_density(strain, p)
        for name in sorted({key.split(".")[0] for key in p if "." in key} - set(MEMBRANES)):
            law = _find(name)
            assert isinstance(law, Membrane)
            first = first + law.density(strain, e, lent(p, name))
        below = torch.clamp(first, max=p["reach"])
        return -p["share"] * (below - 0.5 * below * below / p["reach"])


def _stiffens(name: str) -> bool:
    """Whether an effect is a law of the strain alone: of no history, and of no other effect's parameters."""
    law = _find(name)
    return isinstance(law, Membrane) and not law.needs_step and not law.borrows


def _find(name: str) -> Effect:
    """As the registry's, which imports this file."""
    from caphy.effects.registry import find_effect

    return find_effect(name)
