"""What base measurements give: parameters, and what is left where nothing is missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.diagnose.outside import outside
from caphy.diagnose.search import search
from caphy.effects.model import Model
from caphy.refit.study import Study

_MOST = 2  # corrections


@dataclass(frozen=True, eq=False)
class Base:
    """Learned from base measurements.

    Attributes:
        model: with what they ask for: parameters fitted, and effects that stand for what the mesh and the solver get
            wrong. Nothing is missing there, so an effect that they seem to need is such a correction.
        changed: fitted numbers, by "effect.parameter"; relative changes of the user's own parameters. Empty where the
            user's model was good.
        gain: best gain of the library after that.
        probes: best gain of flexible forces after that.
        variance: what is left in each mode at each lag (L, M) [m^2].
        median_mm: median distance there.
    """

    model: Model
    changed: dict[str, float]
    gain: float
    probes: float
    variance: np.ndarray
    median_mm: float


def from_base(study: Study, model: Model, on_body: bool) -> Base:
    """Correct a model by base measurements, then see what the library would wrongly find there."""
    found = search(study, model, model, on_body, most=_MOST)
    last, changed = found.screens[-1], {}
    if found.fit is not None:
        changed = dict(zip([c.name for c in found.fit.columns], map(float, found.fit.change), strict=True))
    errors = np.concatenate([response.error.ravel() for response in last.responses])
    best = max([score.gain for score in last.scores] + [0.0])
    flexible = max([0.0, *outside(found).gains.values()])
    return Base(found.model, changed, best, flexible, last.variance, 1e3 * float(np.nanmedian(errors)))
