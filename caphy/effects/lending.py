"""The elasticity of whatever membrane and bending a model has, for effects that change its rest shape or wear it out.

The membrane is one of :data:`MEMBRANES` and every law of the strain alone that is added to it, a user's too; the
bending is one of :data:`BENDINGS` and :data:`STIFFENINGS`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Values, lent
from caphy.effects.bending import Bending, bending_stiffness
from caphy.effects.bending_anisotropy import uneven_stiffness
from caphy.effects.bending_measured import BendingMeasured, measured_moments
from caphy.effects.cloth import Cloth
from caphy.effects.extra_bending import extra_stiffness
from caphy.effects.membrane import Membrane, Symmetric

MEMBRANES = ("strain_stvk", "strain_measured")
BENDINGS = ("bending", "bending_measured")
STIFFENINGS = ("extra_bending", "bending_anisotropy")


class OfMembrane(Membrane):
    """Base of faces whose energy follows from the model's membrane and whatever else stiffens it in its plane."""

    borrows = (MEMBRANES,)

    def lenders(self, present: Iterable[str]) -> tuple[str, ...] | None:
        names = set(present)
        needed = super().lenders(names)
        return None if needed is None else (*needed, *sorted(n for n in names - set(MEMBRANES) if _stiffens(n)))


def _stiffens(name: str) -> bool:
    """Whether an effect is a law of the strain alone: of no history, no other effect's parameters, and no constants of
    its own, of which a borrower's elements know nothing."""
    law = _find(name)
    reads = law.needs_step or law.reads_step or law.needs_body or law.borrows or law.heeds
    own = [getattr(type(law), key) is getattr(Membrane, key, None) for key in ("index", "rest", "energy")]
    return isinstance(law, Membrane) and not reads and all(own)


def _find(name: str) -> Effect:
    """As the registry's, which imports this file."""
    from caphy.effects.registry import find_effect

    return find_effect(name)


def membrane_density(strain: Symmetric, e: Elements, p: Values) -> Tensor:
    """Energy per rest area (..., n) [N/m] of the laws that lend their parameters to an :class:`OfMembrane`."""
    density = torch.zeros_like(strain[0])
    for name in sorted({key.split(".")[0] for key in p if "." in key}):
        law = _find(name)
        assert isinstance(law, Membrane)
        density = density + law.density(strain, e, lent(p, name))
    return density


def bending_rest(cloth: Cloth) -> dict[str, np.ndarray]:
    """Rest constants of hinges that :func:`bending_energy` and :func:`bending_moment` read."""
    return Bending().rest(cloth) | BendingMeasured().rest(cloth)


def bending_energy(turn: Tensor, rest: Mapping[str, Tensor], p: Values) -> Tensor:
    """Energy (..., n) [J] of hinges turned from their rest angles by (..., n) [rad], of those that lend."""
    energy = torch.zeros_like(turn)
    for stiffness in _stiffnesses(rest, p):
        energy = energy + stiffness * turn * turn
    if measured := lent(p, "bending_measured"):
        energy = energy + measured_moments(turn, rest, measured)[0]
    return energy


def bending_moment(turn: Tensor, rest: Mapping[str, Tensor], p: Values) -> Tensor:
    """Derivative (..., n) [N m] of :func:`bending_energy` by the turn."""
    moment = torch.zeros_like(turn)
    for stiffness in _stiffnesses(rest, p):
        moment = moment + 2 * stiffness * turn
    if measured := lent(p, "bending_measured"):
        moment = moment + measured_moments(turn, rest, measured)[1]
    return moment


_STIFFNESSES = {
    "bending": bending_stiffness,
    "extra_bending": extra_stiffness,
    "bending_anisotropy": uneven_stiffness,
}


def _stiffnesses(rest: Mapping[str, Tensor], p: Values) -> list[Tensor]:
    """Energy per squared angle (n,) [J] of each lender whose moment is in proportion to the angle."""
    return [of(rest, values) for name, of in _STIFFNESSES.items() if (values := lent(p, name))]
