"""Whether base measurements are of before effects were added to a model that a refit or a diagnosis has changed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caphy.effects.model import Model
from caphy.errors import Diverged
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


def earlier(study: Study, model: Model) -> Earlier:
    """The model that lies nearest to measurements, of itself and of those it was before effects were added to it.

    Who looks again at a model with an effect that base measurements do not know gives the same base measurements again:
    fitted to them, the effect would all but go.
    """
    found = Earlier(model, (), (0.0, 0.0))
    stages = [found]
    for revision in reversed(model.history):
        gone = tuple(name for name in revision.added if name in stages[-1].model.effects)
        if gone:
            less = stages[-1].model
            for name in gone:
                less = less.without_effect(name)
            stages.append(Earlier(less, (*gone, *stages[-1].later), (0.0, 0.0)))
    if len(stages) == 1:
        return found
    medians = [_median_mm(study, stage.model) for stage in stages]
    best = int(np.argmin(medians))
    return replace(stages[best], median_mm=(medians[best], medians[0]))


def _median_mm(study: Study, model: Model) -> float:
    """Median distance in all windows; endless where cloth flies apart."""
    try:
        responses = study.respond(model, (), "base measurements")
    except Diverged:
        return np.inf
    return 1e3 * float(np.nanmedian(np.concatenate([response.error.ravel() for response in responses])))
