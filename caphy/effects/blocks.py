"""Element Hessians of every effect, added to the 3x3 blocks of a sparse matrix.

The effects that every model has go through compiled loops. Other membranes' follow from their stress and tangent,
other hinges' from their moment and stiffness: a few numbers an element.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from caphy.effects import block_kernels
from caphy.effects.attachment import Attachment
from caphy.effects.base import BodyState, Effect, Elements, Step
from caphy.effects.bending import Bending
from caphy.effects.bending_anisotropy import BendingAnisotropy
from caphy.effects.bending_damping import BendingDamping
from caphy.effects.body_contact import BodyContact
from caphy.effects.compiled import DRAGS_AND_WINDS
from caphy.effects.extra_bending import ExtraBending
from caphy.effects.gravity import Gravity
from caphy.effects.gust import Gust
from caphy.effects.hinge import Hinge
from caphy.effects.inertia import Inertia
from caphy.effects.membrane import Deformation, Membrane
from caphy.effects.potential import Potential, Term
from caphy.effects.strain_stvk import StrainStVK

COMPILED: Mapping[type[Effect], Callable | None] = {
    StrainStVK: block_kernels.strain_stvk,
    Bending: block_kernels.bending,
    ExtraBending: block_kernels.bending,
    BendingAnisotropy: block_kernels.bending,
    BendingDamping: block_kernels.bending_damping,
    Inertia: block_kernels.spring,
    Attachment: block_kernels.spring,
    BodyContact: block_kernels.body_contact,
    **dict.fromkeys(DRAGS_AND_WINDS, block_kernels.air),
    Gust: None,
    Gravity: None,
}
"""Loops that add the Hessians of effects, called with what :data:`caphy.effects.potential.kernel_of` says; None where
there is nothing to add."""


def add_blocks(
    potential: Potential,
    term: Term,
    x: Tensor,
    step: Step | None,
    body: BodyState | None,
    projection: float,
    slots: np.ndarray,
    blocks: np.ndarray,
) -> None:
    """Add an effect's element Hessians to ``blocks`` (B, 3, 3) [N/m].

    Args:
        potential, term: the effect, and what it is a part of.
        x, step, body: positions (V, 3) [m] and the situation.
        projection: 0 for exact Hessians, 1 for positive semi-definite ones, in between a mixture. Vertices' are
            exact or not, but for abrupt effects, whose exact ones lead too far at first and converge at last.
        slots: places among the blocks of the pairs of an element's corners (n, k, k), -1 where not stored.
    """
    effect = type(term.effect)
    if effect in COMPILED and (loop := potential.loop(term, x, step, body)) is not None:
        if (add := COMPILED[effect]) is not None:
            add(_array(x)[None], *loop.fields, *loop.constants, float(projection), slots, blocks)
        return
    elements = potential.elements(term, x, step, body)
    if issubclass(effect, Membrane) and effect.hessian is Membrane.hessian:
        _add_membrane(term, elements, _array(x), projection, slots, blocks)
    elif issubclass(effect, Hinge) and effect.hessian is Hinge.hessian:
        _add_hinge(term, elements, _array(x), projection, slots, blocks)
    else:
        hessians = (term.effect.hessian, term.effect.projected_hessian)
        mixed = term.effect.element != "vertex" or term.effect.abrupt
        mixture = projection if mixed else float(projection > 0)
        found = _mixed(lambda convex: hessians[convex](elements, term.values), mixture)
        block_kernels.scatter(found, slots, blocks)


def _array(value: Tensor) -> np.ndarray:
    return value.detach().contiguous().numpy()


def _add_membrane(term: Term, e: Elements, x: np.ndarray, projection: float, slots, blocks) -> None:
    strain = Deformation.of(e).strain

    def response(convex: bool) -> Tensor:
        stress, tangent = term.effect.response(strain, e, term.values, convex)  # pyright: ignore
        return torch.stack([*stress, *tangent])

    found = _mixed(response, projection)
    hat, area = (term.rest[key].numpy() for key in ("hat", "area"))
    block_kernels.membrane(x[None], term.index.numpy(), hat, area, found[:3], found[3:], slots, blocks)


def _add_hinge(term: Term, e: Elements, x: np.ndarray, projection: float, slots, blocks) -> None:
    index = term.index.numpy()
    angle = torch.empty(len(index), dtype=torch.float64)
    block_kernels.angles(x[None], index, angle.numpy())

    def response(convex: bool) -> Tensor:
        moment, stiffness = term.effect.response(angle, e, term.values, convex)  # pyright: ignore
        return torch.stack([torch.zeros_like(moment) if convex else moment, stiffness.expand_as(moment)])

    found = _mixed(response, projection)
    length, area = (term.rest[key].numpy() for key in ("length", "area"))
    block_kernels.hinge(x[None], index, length, area, found[0], found[1], slots, blocks)


def _mixed(response: Callable[[bool], Tensor], projection: float) -> np.ndarray:
    """The exact response for projection 0, the convex one for 1, in between their mixture."""
    if projection in (0, 1):
        return response(projection == 1).contiguous().numpy()
    return torch.lerp(response(False), response(True), projection).contiguous().numpy()
