"""Where an effect that is not linear in a parameter is looked for: the frequency of a gust.

An effect without strength changes nothing, whatever its setting, so that one roll-out tells what each of them would do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch

from caphy.effects.candidates import switched_off
from caphy.effects.model import Model
from caphy.effects.registry import find_effect
from caphy.refit.columns import addition, forces
from caphy.refit.evidence import Evidence, bounded
from caphy.refit.responses import Watched
from caphy.refit.tangents import Pushes

Setting = Mapping[str, float]
"""Values of the parameters in which an effect is not linear."""


def settings(name: str) -> list[Setting]:
    """All settings at which an effect is looked for; none if that is only as by default."""
    further = {key: values for key, values in find_effect(name).further.items() if values}
    return [dict(zip(further, values, strict=True)) for values in product(*further.values())] if further else []


def best_setting(known: Evidence, model: Model, name: str) -> tuple[int, float]:
    """The setting in which an effect would explain most, by its place among :func:`settings`.

    Args:
        known: what windows against the model say of :class:`Settings`.

    Returns:
        The place, and the share of the misfit that the effect would take away in the windows that it is fitted to.
    """
    columns = addition(name)
    lower, upper = np.array([column.bounds(model) for column in columns]).T
    shares = []
    for first in range(0, len(columns) * len(settings(name)), len(columns)):
        normal, right = known.picked(range(first, first + len(columns))).normal
        change = bounded(normal, right, lower, upper)
        shares.append(float(2 * change @ right - change @ normal @ change) / float((known.weight * known.c).sum()))
    best = int(np.argmax(shares))
    return best, shares[best]


def in_setting(model: Model, name: str, place: int) -> Model:
    """The model with an effect added, switched off, in one of its settings."""
    return model.with_effect(name, **{**switched_off(name), **settings(name)[place]})


@dataclass(frozen=True, eq=False)
class Settings:
    """What one unit of each coefficient of an effect does in each of its settings; other processes can be told."""

    model: Model
    name: str

    @property
    def count(self) -> int:
        """How many forces these are."""
        return len(addition(self.name)) * len(settings(self.name))

    def __call__(self, watched: Watched) -> Pushes:
        columns = addition(self.name)
        places = range(len(settings(self.name)))
        each = [watched.scene.potential(in_setting(self.model, self.name, place)) for place in places]
        return lambda x, step, body: torch.cat([forces(one, columns, x, step, body) for one in each], -3).movedim(-3, 0)
