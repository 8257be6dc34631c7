"""Clouds registered again by the model that was fitted to them, until its numbers stay.

A cloud does not hold the vertices; what it leaves open its registration takes from the model. A model that lacks a
stiffness draws the vertices towards cloth that is without it, and what is fitted to them is too small. Registered by
the model that was fitted they ask for more of it, and so on, by steps that shrink by one factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.effects.model import Model
from caphy.errors import Diverged
from caphy.refit.columns import changes, extended
from caphy.refit.descent import fit, gone_further, refined, retold, tried, weighed_anew
from caphy.refit.evidence import Weighing
from caphy.refit.fit import Fit
from caphy.refit.responses import Response
from caphy.refit.study import Study

TIMES = 3
"""Registrations of fitted models, at most."""

_STEEPEST = 0.8  # change of what is told by that of the registering model, that is believed at most
_STAYS = 0.06  # of a fit's change, by what windows can tell: how far it may be from where both would agree


@dataclass(frozen=True, eq=False)
class Again:
    """A fit to clouds that were registered by a model like it.

    Attributes:
        study: the windows of these clouds.
        fit: the model fitted to them.
        before: these windows against the fit's origin.
        times: how often clouds were registered again.
    """

    study: Study
    fit: Fit
    before: list[Response]
    times: int = 1


def fitted_again(study: Study, best: Fit, variance: np.ndarray, weigh: bool = False) -> Again | None:
    """Fit a model to clouds registered by what was fitted to them, until both agree; none where clouds are not at hand.

    Args:
        best: fitted to the ``study`` as it was registered first.
        variance: of each mode at each lag (L, M) [m^2].
        weigh: tell variance and weights anew at last, as :func:`caphy.refit.descent.weighed_anew`.
    """
    found, first = None, best
    pairs, there = [(np.zeros_like(best.change), best.change)], best.model
    for _ in range(TIMES):
        other = study.registered_by(there)
        again = None if other is study else _fitted(other, best, there, variance)
        if again is None:
            break
        found, best = again, again.fit
        told, metric = best.change, best.evidence.normal[0]
        pairs.append((changes(extended(best.origin, best.columns), there, best.columns), told))
        meeting = agreed(pairs, metric)
        if _size(meeting - told, metric) < _STAYS * _size(told, metric):
            break
        there = best.ahead(meeting)
    if found is None:
        return None
    if weigh:
        best = weighed_anew(found.study, best)
    gone = gone_further(first.by_retelling, best.columns, best.change - first.change)
    return replace(found, fit=replace(best, by_retelling=gone), times=len(pairs) - 1)


def as_registered_first(whose: str, study: Study, again: bool) -> tuple[str, ...]:
    """Why clouds of a study were not registered ``again`` by what was fitted, in words; nothing where they were, or
    there are none."""
    if again or not study.of_clouds:
        return ()
    why = study.why_not or "its cloth flies apart"
    return (f"{whose} were not registered again by what was fitted: {why}",)


def _size(change: np.ndarray, metric: np.ndarray) -> float:
    return float(np.sqrt(max(change @ metric @ change, 0.0)))


def agreed(pairs: Sequence[tuple[np.ndarray, np.ndarray]], metric: np.ndarray) -> np.ndarray:
    """The numbers (K,) at which what is told should be what was registered by, from pairs (registered by, told).

    A straight line through the pairs, with one slope for all numbers, by least squares in a ``metric`` (K, K): each
    fit has its noise, which a secant through two of them (Aitken, Anderson) would follow. Its slope is believed up to
    :data:`_STEEPEST`.
    """
    at, told = (np.array(each) for each in zip(*pairs, strict=True))
    middle, answer = at.mean(0), told.mean(0)
    spread = float(np.einsum("pk,kl,pl->", at - middle, metric, at - middle))
    along = float(np.einsum("pk,kl,pl->", at - middle, metric, told - answer))
    slope = np.clip(along / spread if spread > 0 else 0.0, -_STEEPEST, _STEEPEST)
    return answer + slope / (1 - slope) * (answer - middle)


def _fitted(study: Study, best: Fit, there: Model, variance: np.ndarray) -> Again | None:
    """A fit carried on in other windows, from a model that it may come to; none where cloth flies apart.

    What is told of the mesh and what of the registration hang on each other, so that of several small steps each leads
    to the next: it is fitted on though a step promises little.
    """
    columns, what = best.columns, "clouds registered again"
    try:
        before = study.respond(best.origin, columns, what)
    except Diverged:
        return None
    weighing = Weighing.robust(before, variance)
    start = fit(study, best.origin, columns, before, weighing, what, 0)
    found = tried(study, start, there, what, {"solver"})
    if found is None:
        return None
    found = retold(study, refined(study, found, what))
    return Again(study, replace(found, follow=best.follow), before)
