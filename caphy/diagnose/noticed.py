"""How much of an effect the windows would have shown."""

from __future__ import annotations

from collections.abc import Sequence
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
    tried, found[column.name] = [], None
    while len(tried) < _ROLL_OUTS and (size := _next_size(tried, needed, most)) <= most:
        try:
            after = few.respond(moved(screen.model, [column], np.array([size])), (), what)
        except Diverged:
            break
        does = [replace(old, residual=old.residual - new.residual) for old, new in zip(before, after, strict=True)]
        normal, right = evidence(does, screen.variance, screen.evidence.weight[windows]).normal
        tried.append((size, max(float(right[0] / normal[0, 0]), 1e-300)))
        if tried[-1][1] >= _AS_PROMISED * needed:
            return {**found, column.name: _reaching(tried, _AS_PROMISED * needed)}
    return found


def _next_size(tried: Sequence[tuple[float, float]], needed: float, most: float) -> float:
    """The size to try after some, each with the size that it looks like; beyond ``most`` where none is left."""
    if not tried:
        return needed
    size, looks = tried[-1]
    if size == most:
        return np.inf
    if len(tried) == _ROLL_OUTS - 1:  # what is noticed at no size is not noticed at the largest
        return most
    return min(size * min(max(needed / looks, 1.2), 3.0), most)


def _reaching(tried: Sequence[tuple[float, float]], wanted: float) -> float:
    """The size that looks like a wanted one, which the last of some does, by a power law through the last two."""
    if len(tried) < 2:
        return tried[-1][0]
    (small, less), (large, more) = tried[-2:]
    return small * (large / small) ** float(np.log(wanted / less) / np.log(more / less))
