"""Whether base measurements are of before effects were added to a model that a refit or a diagnosis has changed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caphy.effects.model import Model
from caphy.errors import Diverged
from caphy.refit.responses import median_mm
from caphy.refit.study import Study


@dataclass(frozen=True)
class Earlier:
    """The model of which measurements are.

    Attributes:
        model: without what was added since.
        later: names of what was added since.
        median_mm: median distance in windows, of that model and of the one with everything.
    """

    model: Model
    later: tuple[str, ...]
    median_mm: tuple[float, float]

    def with_later(self, other: Model, whole: Model) -> Model:
        """Another model with what was added since, as it is in the whole one."""
        return replace(whole, density=other.density, effects={**whole.effects, **other.effects})


def earlier(study: Study, model: Model) -> Earlier | None:
    """The model that measurements are of, if one from before effects were added lies nearer to them than the whole one.

    Who looks again at a model with an effect that base measurements do not know gives the same base measurements again:
    fitted to them, the effect would all but go.
    """
    stages: list[tuple[Model, tuple[str, ...]]] = [(model, ())]
    for revision in reversed(model.history):
        less, later = stages[-1]
        gone = tuple(name for name in revision.added if name in less.effects)
        for name in gone:
            less = less.without_effect(name)
        if gone:
            stages.append((less, (*gone, *later)))
    if len(stages) == 1:
        return None
    medians = [_off(study, stage) for stage, _ in stages]
    best = int(np.argmin(medians))
    return Earlier(*stages[best], (medians[best], medians[0])) if best else None


def _off(study: Study, model: Model) -> float:
    """Median distance in all windows [mm]; endless where cloth flies apart."""
    try:
        return median_mm(study.respond(model, (), "base measurements"))
    except Diverged:
        return np.inf
