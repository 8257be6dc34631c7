"""Fits of a model's numbers to windows, by Gauss-Newton on real roll-outs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from caphy.effects.model import Model
from caphy.errors import Diverged
from caphy.refit.columns import Column, from_the_end, moved
from caphy.refit.evidence import Weighing
from caphy.refit.fit import LARGE, Fit, judged, share_gone
from caphy.refit.responses import Response
from caphy.refit.study import Study

ROUNDS = 7
"""Gauss-Newton steps that are taken in any case, as long as one promises something."""
_MOST_ROUNDS, _STILL_FALLS = 40, 0.01  # in all at most, and of the misfit what each further one must take away
_MORE_THAN_PROMISED, _LONGEST = 1.5, 4.0  # times a promise: a fall after which the next step is longer, times at most
_SHORTER = 0.4
_ROUGH = 0.05  # of the misfit: what differs between roll-outs of almost the same model, because folds snap
_FUTILE = 0.03  # of the misfit: a promise that is not worth a shorter step; slopes tell if it is kept
_FUTILE_ANEW = 0.003  # the same where errors are told anew
_AGREE, _FARTHEST = 0.9, 5.0  # cosine of two steps that are of one way; times that the second is longer at most
_WEIGHED = 3  # times that variance and weights are told anew

RETELLINGS = 7
"""Times at most that the errors of time step and mesh are told of a fitted model."""


def fit(
    study: Study,
    model: Model,
    columns: Sequence[Column],
    responses: Sequence[Response],
    weighing: Weighing,
    what: str = "fitting",
    rounds: int | None = None,
) -> Fit:
    """Change numbers of a model so that its roll-outs meet the windows.

    Gauss-Newton, with shorter steps where one makes things worse; bounds are kept. Windows start where the measurement
    says, whatever the model: starts that followed the fit would make any fit look better than none.

    Args:
        responses: of the model as given, in these columns.
        rounds: steps at most; as many as are of use unless given.
    """
    columns = tuple(columns)
    start = judged(model, model, columns, list(responses), weighing, windows=responses)
    return refined(study, start, what, rounds)


def refined(
    study: Study,
    best: Fit,
    what: str = "fitting",
    rounds: int | None = None,
    enough: float = 0.0,
    anew: Collection[str] = (),
) -> Fit:
    """A fit carried on until it has settled, or another step promises no more than ``enough`` of the misfit.

    Without ``rounds`` a fit that still falls goes on, or it would end on its way: the more there is of a drag the less
    a further bit of it does, so that steps towards a strong one are short. Where the misfit falls by more than was
    promised the next step is twice as long as it would be, after another such one four times. Errors ``anew``, as of
    :meth:`caphy.refit.study.Study.respond`, are told of each model on the way; what a step promises knows nothing of
    what they will be, so that a shorter one is worth while where it promises little.
    """
    futile = _FUTILE_ANEW if anew else _FUTILE
    step, fell, longer = best.step, 1.0, 1.0
    for done in range(_MOST_ROUNDS if rounds is None else rounds):
        if rounds is None and done >= ROUNDS and fell < _STILL_FALLS:
            return best
        there = moved(best.model, best.columns, step)
        found = tried(study, best, there, what, anew)
        before = max(best.misfit, 1e-300)
        fell = 0.0 if found is None else 1 - found.misfit / before
        if found is not None and (fell > -_ROUGH or (found.by_instruments is not None and _falls(best, found, step))):
            more = fell > max(_STILL_FALLS, _MORE_THAN_PROMISED * best.promise / before)
            longer = min(2 * longer, _LONGEST) if more else 1.0
            if anew:
                longer = max(longer, _to_its_end(best, found, step))
            best, step = found, _no_farther_back(best, found, step, found.longer_step(longer))
            if best.settled and not more:
                return replace(best, converged=True)
            if best.promise < enough * best.misfit:
                return best
        elif best.promise < futile * best.misfit:
            return found if found is not None and _falls(best, found, step) else best
        else:
            step = _SHORTER * step
    return best


def _no_farther_back(best: Fit, found: Fit, step: np.ndarray, further: np.ndarray) -> np.ndarray:
    """The further step after one that went too far, no longer than back to where slopes at both its ends say that the
    misfit is least (regula falsi).

    Where tangents say half of what roll-outs do, steps go to and fro over it for as long as they are let.
    """
    last = from_the_end(best.columns, step)
    before, after = (known.along(way)[0].sum() for known, way in ((best.asked, step), (found.asked, last)))
    if not before < 0 < after:
        return further
    normal = found.asked.normal[0]
    whole, asked = (np.sqrt(way @ normal @ way) for way in (last, further))
    return further * min(1.0, after / (after - before) * whole / max(asked, 1e-300))


def _to_its_end(best: Fit, found: Fit, step: np.ndarray) -> float:
    """How many times as long the further step is for errors to have followed once it is taken; one where it turns.

    What is asked for shrinks by less than the step that was taken: where that goes on evenly it is used up there (the
    secant's; Aitken's, Proc. R. Soc. Edinburgh 46, 1926, for steps in full).
    """
    metric, further = found.asked.normal[0], found.step
    along, square = float(step @ metric @ further), float(step @ metric @ step)
    if along < _AGREE * np.sqrt(max(square * float(further @ metric @ further), 1e-300)):
        return 1.0
    shrinks = float(step @ metric @ (best.step - further))
    return float(np.clip(square / shrinks, 1.0, _FARTHEST)) if shrinks > 0 else _FARTHEST


def _falls(best: Fit, found: Fit, step: np.ndarray) -> bool:
    """Whether slopes at both ends of a step say that the misfit falls. One window of a dozen whose cloth snaps into
    another fold raises it by more than a weak effect takes away."""
    return share_gone(best.asked, found.asked, step, from_the_end(best.columns, step))[0] > 0


def weighed_anew(study: Study, best: Fit, what: str = "weighing anew") -> Fit:
    """A fit that took a large part of the misfit away, carried on with variance and weights that are told by what it
    leaves over.

    Those of the model that it began with were told where a strong effect was missing, and its tangents explained only a
    part of that: what they did not looks like noise, most in windows and at lags in which the effect did most. So far a
    drag of 3.0 was told as 2.4. Weights that follow the fit are iteratively reweighted least squares (Holland, Welsch,
    Commun. Stat. A 6, 1977).
    """
    if best.share < LARGE:
        return best
    old, kept = best.evidence, {"by_retelling": best.by_retelling, "follow": best.follow}
    origin = study.respond(best.origin, best.columns, what)
    for _ in range(_WEIGHED):
        weighing = Weighing.robust(best.responses, study.variance(best.responses))
        first = weighing.of(origin)
        best = judged(best.origin, best.model, best.columns, best.responses, weighing, None, first, origin)
        if best.settled:
            best = replace(best, converged=True)
            break
        best = refined(study, best, what)
    return replace(best, weighed_first=old, **kept)


def tried(study: Study, best: Fit, there: Model, what: str, anew: Collection[str] = ()) -> Fit | None:
    """A fit moved to another model, or none where cloth flies apart there."""
    try:
        responses = study.respond(there, best.columns, what, anew=anew)
    except Diverged:
        return None
    known, snaps = (best.weighing, best.most, best.first, best.windows), best.by_instruments is not None
    return judged(best.origin, there, best.columns, responses, *known, snaps=snaps)


def retold(study: Study, best: Fit, what: str = "what mesh and steps do now") -> Fit:
    """A fit carried on with what finer steps do otherwise, and a finer mesh where it is known how much of that is
    there, told of the fitted model.

    A coarse mesh and long steps do not answer a stiffness or a damping as the cloth does, and cloth that is damped
    leaves them less to get wrong: their errors are told of each model that a step leads to, and a misfit that falls
    with them is progress. By errors that stay as they were told a viscosity of 2.10 N s/m ends at 0.52, and by those
    told of it there it is to go on to ten times as much.
    """
    before, began = best.by_retelling, best.change
    told = tried(study, best, best.model, what, {"solver"})
    if told is None:
        return best
    best = replace(told, converged=True) if told.settled else refined(study, told, what, RETELLINGS, anew={"solver"})
    if not best.converged:
        study.tell(best.model, what)  # the last step may have been given up
    return replace(best, by_retelling=gone_further(before, best.columns, best.change - began))


def gone_further(before: Mapping[Column, float], columns: Sequence[Column], change: np.ndarray) -> dict[Column, float]:
    """:attr:`Fit.by_retelling` of columns that went by a further ``change`` (K,)."""
    return {c: float(np.hypot(by, before.get(c, 0.0))) for c, by in zip(columns, change, strict=True)}
