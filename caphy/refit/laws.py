"""What is not linear in an effect that was found: another law of it, or parameters such as a frequency.

They cannot be found from nothing, and start from what was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from caphy.effects.model import Model
from caphy.effects.registry import find_effect, registered_effects
from caphy.refit.columns import Column, addition, further
from caphy.refit.evidence import evidence, ridged
from caphy.refit.study import Fit, Study, fit


def law_of(name: str) -> str | None:
    """The effect that refines another, if there is one."""
    return next((law for law, effect in registered_effects().items() if effect.refines == name), None)


def in_another_law(study: Study, best: Fit, law: str, variance: np.ndarray, weight: np.ndarray) -> Fit:
    """A fit with the effect ``law`` in the place of the one that it refines, all numbers fitted on.

    Its origin has the effect without strength but otherwise as fitted, so that tangents can tell the way from there.
    """
    effect = find_effect(law)
    assert effect.refines is not None
    columns = (*(column for column in best.columns if column.effect != effect.refines), *addition(law))
    values = effect.start(best.model.effects[effect.refines])
    start = best.model.without_effect(effect.refines).with_effect(law, **values)
    found = _fitted_on(study, best, start, law, columns, variance, weight)
    return replace(found, follow=_led_astray(study, found, law, addition(effect.refines), variance))


def told_further(study: Study, best: Fit, name: str, variance: np.ndarray, weight: np.ndarray) -> Fit:
    """A fit carried on with those parameters of an effect in which it is not linear."""
    return _fitted_on(study, best, best.model, name, (*best.columns, *further(name)), variance, weight)


def _fitted_on(
    study: Study,
    best: Fit,
    start: Model,
    name: str,
    columns: Sequence[Column],
    variance: np.ndarray,
    weight: np.ndarray,
) -> Fit:
    what = f"trying {name}"
    # Errors of the mesh may last have been told of a model that was tried and given up.
    responses = study.respond(start, columns, what, anew={"solver"})
    found = fit(study, start, columns, responses, variance, weight, what, most=best.most)
    fitted = found.model.effects[name]
    nothing = {key: np.zeros_like(fitted[key]) for key in find_effect(name).coefficients}
    idle = best.origin.with_effect(name, **{**fitted, **nothing})
    first = evidence(study.respond(idle, columns, what, anew={"solver"}), variance, best.first.weight)
    return replace(found, origin=idle, first=first)


def _led_astray(
    study: Study, found: Fit, law: str, others: Sequence[Column], variance: np.ndarray
) -> dict[Column, dict[Column, float]]:
    """How far one unit of each of the linear effect's numbers, where it is not there, leads each of the law's astray.

    Base measurements know how much of the linear effect mesh and solver look like; of the law they cannot know, since
    without strength its velocity moves nothing.
    """
    many = len(found.columns)
    responses = study.respond(found.model, (*found.columns, *others), f"trying {law}")
    normal, _ = evidence(responses, variance, found.evidence.weight).normal
    by = np.array([ridged(normal[:many, :many], right, 1e-9) for right in normal[:many, many:].T]).T
    return {
        column: dict(zip(others, map(float, row), strict=True))
        for column, row in zip(found.columns, by, strict=True)
        if column.effect == law
    }


def falls(before: Fit, after: Fit) -> np.ndarray:
    """By how much the misfit of each window (W,) falls from one fit to another of the same windows."""
    here, there = (each.evidence.misfit(np.zeros(len(each.columns))) for each in (before, after))
    return here - there
