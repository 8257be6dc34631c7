"""How much of an effect the windows would have shown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.diagnose.screen import Score, covariance
from caphy.diagnose.search import Screen
from caphy.errors import Diverged
from caphy.refit.columns import extended, moved
from caphy.refit.evidence import evidence
from caphy.refit.fit import FURTHEST
from caphy.refit.study import Study

LISTED = 3
"""Explanations, best first, whose first number is told by roll-outs: those that the answer names."""

_MOST = 1e12  # a size beyond which a number does nothing here
_SURELY = 1.645  # standard errors: a number that is told too small by more is one of twenty
_WINDOWS = 5  # those in which a number does most, that are rolled out
_ROLL_OUTS = 4
_AS_PROMISED = 0.9  # of what tangents promise that must be there


def by_tangents(screen: Screen, score: Score, wald: float) -> dict[str, float]:
    """Smallest size of each number of an explanation that would have been noticed in 19 cases of 20, if what it does
    grew evenly: wherever noise shifts the estimate, it must gain what is needed, and its square over its error's must
    be ``wald``."""
    found = {}
    for column, place in zip(score.group.columns, screen.places[score.group.label], strict=True):
        known = screen.evidence.picked([place])
        (curvature,), right = known.normal[0][0], known.normal[1]
        error = np.sqrt(covariance(known, right / max(curvature, 1e-300))[0, 0])
        gains = np.sqrt(screen.needed_by(score) * screen.misfit / max(curvature, 1e-300))
        size = max(gains, np.sqrt(wald) * error) + _SURELY * error
        if np.isfinite(size) and size < _MOST:
            found[column.name] = float(size)
    return found


def by_roll_outs(study: Study, screen: Screen, score: Score, wald: float) -> dict[str, float | None]:
    """The same; of the first number by roll-outs of a model that has so much of it: none where no size up to ten times
    what tangents ask for would have been noticed, or none that the number may have.

    The more a cloth has of a stiffness the less a further bit of it does: 31 N/m of shear moved a skirt as tangents say
    of 12. What a size s does, m(s), looks to the screen like a size of S.m(s) / S.S, with responses S and products
    weighted as the misfit is.
    """
    found: dict[str, float | None] = {**by_tangents(screen, score, wald)}
    column, place = score.group.columns[0], screen.places[score.group.label][0]
    needed = found.get(column.name)
    if needed is None:
        return found
    most = min(column.bounds(extended(screen.model, [column]))[1], FURTHEST * needed)
    strength = screen.evidence.weight * screen.evidence.a[:, place, place]
    windows = sorted(np.argsort(strength)[-_WINDOWS:].tolist())
    few, what = study.some(windows), "what would have been noticed"
    # The mesh's error may last have been told of a model that was tried and given up.
    before = few.respond(screen.model, [column], what, anew={"solver"})
    size, found[column.name] = needed, None
    for _ in range(_ROLL_OUTS):
        if size > most:
            break
        try:
            after = few.respond(moved(screen.model, [column], np.array([size])), (), what)
        except Diverged:
            break
        does = [replace(old, residual=old.residual - new.residual) for old, new in zip(before, after, strict=True)]
        normal, right = evidence(does, screen.variance, screen.evidence.weight[windows]).normal
        looks = float(right[0] / normal[0, 0])
        if looks >= _AS_PROMISED * needed:
            return {**found, column.name: size}
        size *= min(max(needed / max(looks, 1e-300), 1.2), 3.0)
    return found
