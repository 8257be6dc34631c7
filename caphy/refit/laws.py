"""What is not linear in an effect that was found: another law of it, or parameters such as a frequency.

They cannot be found from nothing, and start from what was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import rankdata

from caphy.effects.model import Model
from caphy.effects.registry import find_effect, registered_effects
from caphy.refit.columns import Column, addition, changes, from_the_end, further
from caphy.refit.descent import refined
from caphy.refit.evidence import Weighing, ridged
from caphy.refit.fit import Fit, falls_evenly, judged
from caphy.refit.study import Study

LEAST = 1.0
"""By how many standard deviations of the signed ranks' sum another law must be better."""


def laws_of(name: str) -> list[str]:
    """The effects that refine another: other laws of it."""
    return [law for law, effect in registered_effects().items() if effect.refines == name]


def in_another_law(study: Study, best: Fit, law: str) -> Fit:
    """A fit with the effect ``law`` in the place of the one that it refines, all numbers fitted on.

    Its origin has the effect without strength but otherwise as fitted, so that tangents can tell the way from there.
    """
    effect = find_effect(law)
    assert effect.refines is not None
    columns = (*(column for column in best.columns if column.effect != effect.refines), *addition(law))
    values = effect.start(best.model.effects[effect.refines])
    start = best.model.without_effect(effect.refines).with_effect(law, **values)
    found = _fitted_on(study, best, start, law, columns)
    led = _led_astray(study, found, law, addition(effect.refines))
    return replace(found, follow={**found.follow, **led})


def told_further(study: Study, best: Fit, name: str) -> Fit:
    """A fit carried on with those parameters of an effect in which it is not linear."""
    return _fitted_on(study, best, best.model, name, (*best.columns, *further(name)))


def _fitted_on(study: Study, best: Fit, start: Model, name: str, columns: Sequence[Column]) -> Fit:
    what = f"trying {name}"
    # Errors of the mesh may last have been told of a model that was tried and given up.
    responses = study.respond(start, columns, what, anew={"solver"})
    # Tangents of this start are no instruments: the effect is there, and snaps with it.
    found = judged(start, start, tuple(columns), responses, best.weighing, best.most)
    found = refined(study, found, what)
    idle = _beside(best.origin.without_effect(name), found.model)
    first = best.weighing.of(study.respond(idle, columns, what, anew={"solver"}))
    return replace(found, origin=idle, first=first, by_retelling=best.by_retelling, follow=best.follow)


def _led_astray(study: Study, found: Fit, law: str, others: Sequence[Column]) -> dict[Column, dict[Column, float]]:
    """How far one unit of each of the linear effect's numbers, where it is not there, leads each of the law's astray.

    Base measurements know how much of the linear effect mesh and solver look like; of the law they cannot know, since
    without strength its velocity moves nothing.
    """
    many = len(found.columns)
    responses = study.respond(found.model, (*found.columns, *others), f"trying {law}")
    normal, _ = replace(found.weighing, weight=found.evidence.weight).of(responses).normal
    by = np.array([ridged(normal[:many, :many], right, 1e-9) for right in normal[:many, many:].T]).T
    return {
        column: dict(zip(others, map(float, row), strict=True))
        for column, row in zip(found.columns, by, strict=True)
        if column.effect == law
    }


@dataclass(frozen=True, eq=False)
class Way:
    """From one fit to another: two models with the same effects, and the numbers that lead from here to there.

    An effect that one fit lacks is there without strength.
    """

    here: Model
    there: Model
    columns: tuple[Column, ...]

    def falls(self, study: Study, weighing: Weighing) -> np.ndarray:
        """By how much the misfit of each window (W,) falls, as by :func:`caphy.refit.fit.falls_evenly`."""
        here, there = (
            weighing.of(study.respond(model, self.columns, "comparing", anew={"solver"}))
            for model in (self.here, self.there)
        )
        change = changes(self.here, self.there, self.columns)
        return falls_evenly(here, there, change, from_the_end(self.columns, change))


def way(before: Fit, after: Fit) -> Way:
    """The way from one fit to another."""
    columns = tuple(dict.fromkeys((*before.columns, *after.columns)))
    return Way(_beside(before.model, after.model), _beside(after.model, before.model), columns)


def _beside(model: Model, other: Model) -> Model:
    """A model with the effects that another has and it lacks, without strength."""
    for name in other.effects.keys() - model.effects.keys():
        values = other.effects[name]
        nothing = {key: np.zeros_like(values[key]) for key in find_effect(name).coefficients}
        model = model.with_effect(name, **{**values, **nothing})
    return model


def signed_ranks(differences: np.ndarray) -> float:
    """The sum of signed ranks of differences (N,), in standard deviations that it has where signs are chance
    (Wilcoxon, Biometrics Bulletin 1, 1945)."""
    ranks = rankdata(np.abs(differences))
    return float((np.sign(differences) * ranks).sum() / np.sqrt((ranks**2).sum()))
