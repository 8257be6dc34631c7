"""Clouds registered again by the model that was fitted to them, until its numbers stay.

A cloud does not hold the vertices; what it leaves open its registration takes from the model. A model that lacks a
stiffness draws the vertices towards cloth that is without it, and what is fitted to them is too small. Registered by
the model that was fitted they ask for more of it, and so on, by steps that shrink by one factor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caphy.errors import Diverged
from caphy.refit.columns import changes, extended, moved
from caphy.refit.evidence import evidence, robust_weights
from caphy.refit.responses import Response
from caphy.refit.study import FEWEST, Fit, Study, fit, refined, retold, tried

TIMES = 3
"""Registrations of fitted models, at most."""

_SHRINKS = 0.8  # factor from one step to the next that is believed at most
_STAYS = 0.06  # of a fit's change, by what windows can tell: a difference from the registering model that is none


@dataclass(frozen=True, eq=False)
class Again:
    """A fit to clouds that were registered by a model like it.

    Attributes:
        study: the windows of these clouds.
        fit: the model fitted to them.
        before: these windows against the fit's origin.
    """

    study: Study
    fit: Fit
    before: list[Response]


def fitted_again(study: Study, best: Fit, variance: np.ndarray) -> Again | None:
    """Fit a model to clouds registered by what was fitted to them, until both agree; none where clouds are not at hand.

    Args:
        best: fitted to the ``study`` as it was registered first.
        variance: of each mode at each lag (L, M) [m^2].
    """
    if not any(scene.slides for scene in study.scenes):
        return None
    found: Again | None = None
    at, told = np.zeros_like(best.change), best.change  # the registering model's numbers, those fitted to its clouds
    there = best.model
    for _ in range(TIMES):
        try:
            other = study.registered_by(there)
            again = None if sum(map(len, other.starts)) < FEWEST else _fitted(other, best, variance)
        except Diverged:
            break
        if again is None:
            break
        found, best = again, again.fit
        before, at = (at, told), changes(extended(best.origin, best.columns), there, best.columns)
        told, metric = best.change, best.evidence.normal[0]
        off = told - at
        if off @ metric @ off < _STAYS**2 * (told @ metric @ told):
            break
        there = moved(best.origin, best.columns, agreed(before, (at, told), metric))
    return found


def agreed(
    before: tuple[np.ndarray, np.ndarray], last: tuple[np.ndarray, np.ndarray], metric: np.ndarray
) -> np.ndarray:
    """Where what is told (K,) should be what was registered by, judging by two pairs (registered by, told).

    Anderson's acceleration of a fixed point by one step back (J. ACM 12, 1965), which for one number is the secant; the
    difference is sought in a ``metric`` (K, K). Steps are believed to shrink by :data:`_SHRINKS` at least.
    """
    off = last[1] - last[0]
    since = off - (before[1] - before[0])
    size = float(since @ metric @ since)
    back = float(since @ metric @ off) / size if size > 0 else 0.0
    return last[1] - np.clip(back, -_SHRINKS / (1 - _SHRINKS), 1.0) * (last[1] - before[1])


def _fitted(study: Study, best: Fit, variance: np.ndarray) -> Again | None:
    """A fit carried on in other windows."""
    columns, what = best.columns, "clouds registered again"
    before = study.respond(best.origin, columns, what)
    weight = robust_weights(evidence(before, variance))
    start = fit(study, best.origin, columns, before, variance, weight, what, 0)
    there = tried(study, start, best.model, variance, weight, what)
    if there is None:
        return None
    there = replace(there, by_mesh=best.by_mesh)
    if not there.settled:
        there = replace(refined(study, there, variance, weight, what), by_mesh=best.by_mesh)
        there = retold(study, there, variance, weight)
    return Again(study, replace(there, follow=best.follow), before)
