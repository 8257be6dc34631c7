"""What base measurements give: parameters, and what is left where nothing is missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.diagnose.groups import columns_of, own_groups
from caphy.diagnose.search import screen
from caphy.effects.model import Model
from caphy.refit.evidence import evidence, robust_weights
from caphy.refit.study import Study, fit

_WORTH = 0.02  # share of the misfit that fitted parameters must take away, or the user's stay
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Base:
    """Learned from base measurements.

    Attributes:
        model: with parameters fitted to them.
        changed: relative changes of parameters, by "effect.parameter"; empty where the user's were good.
        gain: best gain of the library there, where nothing is missing.
        variance: what is left in each mode at each lag (L, M) [m^2].
        median_mm: median distance there.
    """

    model: Model
    changed: dict[str, float]
    gain: float
    variance: np.ndarray
    median_mm: float


def from_base(study: Study, model: Model, on_body: bool) -> Base:
    """Fit the model's own parameters to base measurements, then see what the library would wrongly find there."""
    columns, _ = columns_of(own_groups(model, model))
    offsets = study.settled(model)
    responses = study.respond(model, columns, offsets, "base")
    variance = study.variance(responses)
    known = evidence(responses, variance)
    fitted = fit(study, model, columns, responses, variance, robust_weights(known), "base parameters", _ROUNDS)
    start = float((fitted.evidence.weight * known.c).sum())
    worth = fitted.misfit < (1 - _WORTH) * start
    best = fitted.model if worth else model
    found = screen(study, best, best, on_body)
    changed = dict(zip([c.name for c in columns], map(float, fitted.change), strict=True)) if worth else {}
    added = [score.gain for score in found.scores if not score.group.own]
    errors = np.concatenate([response.error.ravel() for response in found.responses])
    return Base(best, changed, max([*added, 0.0]), found.variance, 1e3 * float(np.nanmedian(errors)))
