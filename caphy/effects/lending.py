"""The elasticity of whatever membrane and bending a model has, for effects that change its rest shape or wear it out.

The membrane is one of :data:`MEMBRANES` and every law of the strain alone that is added to it, a user's too; the
bending is one of :data:`BENDINGS` and every law of the dihedral angle alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Values, lent
from caphy.effects.bending import Bending, bending_stiffness
from caphy.effects.bending_anisotropy import uneven_stiffness
from caphy.effects.bending_measured import BendingMeasured, measured_moments
from caphy.effects.cloth import Cloth
from caphy.effects.extra_bending import extra_stiffness
from caphy.effects.hinge import Hinge
from caphy.effects.membrane import Membrane, Symmetric

MEMBRANES = ("strain_stvk", "strain_measured")
BENDINGS = ("bending", "bending_measured")
STIFFENINGS = ("extra_bending", "bending_anisotropy")


class OfMembrane(Membrane):
    """Base of faces whose energy follows from the model's membrane and whatever else stiffens it in its plane."""

    borrows = (MEMBRANES,)

    def lenders(self, present: Iterable[str]) -> tuple[str, ...] | None:
        return _with_laws_alone(super().lenders(present), Membrane, set(present) - set(MEMBRANES))


class OfBending(Hinge):
    """Base of hinges whose energy follows from the model's bending and whatever else stiffens its folds."""

    borrows = (BENDINGS,)
    heeds = STIFFENINGS

    def lenders(self, present: Iterable[str]) -> tuple[str, ...] | None:
        return _with_laws_alone(super().lenders(present), Hinge, set(present) - {*BENDINGS, *STIFFENINGS})


def _with_laws_alone(
    needed: tuple[str, ...] | None, base: type[Effect], others: Iterable[str]
) -> tuple[str, ...] | None:
    """What an effect needs, and those of other effects that are laws of a ``base`` alone."""
    return None if needed is None else (*needed, *sorted(name for name in others if _alone(name, base)))


def _alone(name: str, base: type[Effect]) -> bool:
    """Whether an effect is a law of the strain, or of the angle, alone: of no history, no other effect's parameters,
    and no constants of its own, of which a borrower's elements know nothing."""
    law = _find(name)
    reads = law.needs_step or law.reads_step or law.needs_body or law.borrows or law.heeds
    own = [getattr(type(law), key) is getattr(base, key, None) for key in ("index", "rest", "energy")]
    return isinstance(law, base) and not reads and all(own)


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


def bending_energy(turned: Tensor, e: Elements, p: Values) -> Tensor:
    """Energy (..., n) [J] of hinges turned from their rest angles by (..., n) [rad], of those that lend."""
    energy = torch.zeros_like(turned)
    for stiffness in _stiffnesses(e.rest, p):
        energy = energy + stiffness * turned * turned
    if measured := lent(p, "bending_measured"):
        energy = energy + measured_moments(turned, e.rest, measured)[0]
    for law, values in _other_laws(p):
        energy = energy + law.bent(e.rest["angle"] + turned, e, values)
    return energy


def bending_moment(turned: Tensor, e: Elements, p: Values) -> Tensor:
    """Derivative (..., n) [N m] of :func:`bending_energy` by the turn."""
    moment = torch.zeros_like(turned)
    for stiffness in _stiffnesses(e.rest, p):
        moment = moment + 2 * stiffness * turned
    if measured := lent(p, "bending_measured"):
        moment = moment + measured_moments(turned, e.rest, measured)[1]
    for law, values in _other_laws(p):
        moment = moment + law.response(e.rest["angle"] + turned, e, values)[0]
    return moment


def _other_laws(p: Values) -> Iterator[tuple[Hinge, Values]]:
    """Lending laws of the angle that are no effects of caphy's, and their parameters."""
    for name in sorted({key.split(".")[0] for key in p if "." in key} - {*BENDINGS, *STIFFENINGS}):
        law = _find(name)
        assert isinstance(law, Hinge)
        yield law, lent(p, name)


_STIFFNESSES = {
    "bending": bending_stiffness,
    "extra_bending": extra_stiffness,
    "bending_anisotropy": uneven_stiffness,
}


def _stiffnesses(rest: Mapping[str, Tensor], p: Values) -> list[Tensor]:
    """Energy per squared angle (n,) [J] of each lender whose moment is in proportion to the angle."""
    return [of(rest, values) for name, of in _STIFFNESSES.items() if (values := lent(p, name))]
