"""Which effects a slow pull on a uniform strip can show at all, found by trying them on one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.effects.base import companions, lending
from caphy.effects.lending import MEMBRANES
from caphy.effects.model import Model
from caphy.effects.registry import find_effect, registered_effects
from caphy.tensile.strip import RATE, Strip

HISTORY = {"softening": "reach"}
"""Effects of what happened before a loading, tried on cloth that was loaded before only, with the parameter that holds
the largest energy per area [N/m] that the cloth had then."""

_AXIAL, _TRANSVERSE = np.array([0.05, 0.2]), np.array([0.85, 0.95, 1.05])
_REST = np.zeros(1)
_SAME, _SMALLEST = 1e-3, 1e-9


@dataclass(frozen=True)
class Candidates:
    """What can be told from tensile tests.

    Attributes:
        acting: effects that act in them.
        added: those of them that a model lacks and can be given.
        unseen: why others cannot be told, name -> reason.
    """

    acting: frozenset[str]
    added: tuple[str, ...]
    unseen: dict[str, str]


def candidates(model: Model) -> Candidates:
    """The effects that act in tensile tests of a model."""
    unseen = {name: reason for name in registered_effects() if (reason := _why_unseen(model, name)) is not None}
    acting = frozenset(name for name in registered_effects() if name not in unseen)
    added = tuple(
        name
        for name in sorted(acting)
        if name not in model.effects
        and not (name in MEMBRANES and set(MEMBRANES) & set(model.effects))
        and find_effect(name).coefficients
        and find_effect(name).lenders(model.effects) is not None
    )
    return Candidates(acting, added, unseen)


def _why_unseen(model: Model, name: str) -> str | None:
    """Why tensile tests do not show an effect; None if they do."""
    effect = find_effect(name)
    if not effect.internal or effect.needs_body:
        return "it acts from outside or by mass; a slow pull on a strip does not show it"
    lenders = {n: model.effects.get(n, {}) for n in (lending(effect, model.effects) or companions(effect))}
    alone = Model(model.density, {**lenders, name: {}})
    tables = _tables(alone, name)
    if np.abs(tables).max() < _SMALLEST:
        return "it does not change a pull along weft or warp"
    if not _alike(tables, _tables(alone, name, side=0.2)):
        return "it acts at edges, not in the cloth: the strip's size decides"
    if not _alike(tables, _tables(alone, name, rate=10 * RATE)):
        return "it depends on the rate of strain, which force curves do not carry"
    if not effect.needs_step and np.abs(_tables(alone, name, axial=_REST, transverse=1 + _REST)).max() > _SMALLEST:
        return "it changes the shape at no load, from which strains are counted"
    return None


def _tables(
    model: Model,
    name: str,
    side: float = 0.1,
    rate: float = RATE,
    axial: np.ndarray = _AXIAL,
    transverse: np.ndarray = _TRANSVERSE,
) -> np.ndarray:
    slope = np.full(len(axial), -0.3) if find_effect(name).needs_step else None
    strips = [Strip(axial, direction, side, rate, transverse) for direction in ("weft", "warp")]
    return np.stack([strip.table(model, name, slope)[:2] for strip in strips])  # of forces


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a - b).max() <= _SAME * np.abs(a).max())
