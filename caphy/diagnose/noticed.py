"""How much of an effect the windows would have shown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.diagnose.screen import Score
from caphy.diagnose.search import Screen
from caphy.errors import Diverged
from caphy.refit.columns import extended, moved
from caphy.refit.evidence import evidence
from caphy.refit.fit import FURTHEST
from caphy.refit.responses import picked
from caphy.refit.study import Study

_MOST = 1e12  # a size beyond which a number does nothing here
_WINDOWS = 3  # those in which a number does most, that are rolled out
_ROLL_OUTS = 4
_AS_PROMISED = 0.9  # of what tangents promise that must be there


def by_tangents(screen: Screen, score: Score) -> dict[str, float]:
    """Smallest size of each number of an explanation that would have been noticed, if what it does grew evenly."""
    place = screen.places[score.group.label]
    curvature = np.diag(screen.evidence.normal[0])[place]
    size = np.sqrt(screen.needed_by(score) * screen.misfit / np.maximum(curvature, 1e-300))
    names = [column.name for column in score.group.columns]
    return {name: float(s) for name, s in zip(names, size, strict=True) if np.isfinite(s) and s < _MOST}


def by_roll_outs(study: Study, screen: Screen, score: Score) -> dict[str, float | None]:
    """The same from roll-outs of a model that has so much of it; none where no size up to ten times what tangents ask
    for would have been noticed, or none that the number may have.

    The more a cloth has of a stiffness the less a further bit of it does: 31 N/m of shear moved a skirt as tangents say
    of 4.5, and 6 were needed. What a size s does, m(s), looks to the screen like a size of S.m(s) / S.S, with responses
    S and products weighted as the misfit is.
    """
    found: dict[str, float | None] = {}
    for column, place in zip(score.group.columns, screen.places[score.group.label], strict=True):
        needed = by_tangents(screen, score).get(column.name)
        if needed is None:
            continue
        most = min(column.bounds(extended(screen.model, [column]))[1], FURTHEST * needed)
        strength = screen.evidence.weight * screen.evidence.a[:, place, place]
        windows = sorted(np.argsort(strength)[-_WINDOWS:].tolist())
        few, before = study.some(windows), picked([screen.responses[i] for i in windows], [place])
        size, found[column.name] = needed, None
        for _ in range(_ROLL_OUTS):
            if size > most:
                break
            try:
                after = few.respond(moved(screen.model, [column], np.array([size])), (), "what would have been noticed")
            except Diverged:
                break
            does = [replace(old, residual=old.residual - new.residual) for old, new in zip(before, after, strict=True)]
            normal, right = evidence(does, screen.variance, screen.evidence.weight[windows]).normal
            looks = float(right[0] / normal[0, 0])
            if looks >= _AS_PROMISED * needed:
                found[column.name] = size
                break
            size *= min(max(needed / max(looks, 1e-300), 1.2), 3.0)
    return found
