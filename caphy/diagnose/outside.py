"""Does a force that belongs to no effect explain what is left? Then the answer is what it depends on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caphy.diagnose.search import OVER_BASE, Screen, Search

MORE_AT_FIRST = 1.1, 0.02
"""By what factor, and by how much of the misfit at least, a probe must beat the best explanation of the whole misfit.

Two or three effects together can imitate most smooth forces, so that little may be left to tell; but an effect of the
library explains its own data at least as well as any probe does (29 of 29 cases with one or two hidden effects on the
challenge's square), and five of six forces from outside the library leave a probe well ahead."""

_MORE = 1.5  # times the gain of the best of what is left of the library, at the end
_LEFT = 0.05  # of what is left after effects were accepted: as a further one of the library must without other proof
_SURE = 2.0  # standard errors over windows


@dataclass(frozen=True)
class Outside:
    """What flexible forces explain of the misfit, or of what is left after everything that was accepted.

    Attributes:
        gains: share of the misfit that each probe takes away in windows left out of its fit.
        library: the same for the best of what is left of the library.
        best: the best probe.
        beats: it explains so much more that something acts for which the library has no name.
        change: pressures (K,) [Pa] of the best probe.
        beat: its swings per second, where it swings.
        after: what was accepted before the comparison.
    """

    gains: dict[str, float]
    library: float
    best: str
    beats: bool
    change: np.ndarray
    beat: float | None = None
    after: tuple[str, ...] = ()


def outside(found: Search, floor: float = 0.0) -> Outside:
    """Compare the probes with the library, for the whole misfit and for what is left of it in the end.

    Args:
        floor: best gain of the probes on base measurements, where nothing is missing.
    """
    first = found.screens[0]
    best = max(0.0, *(score.gain for score in first.scores))
    early = _compared(first, max(MORE_AT_FIRST[0] * best, best + MORE_AT_FIRST[1]), floor)
    if early.beats:
        return early
    last = found.screens[-1]
    least = _MORE * max(score.gain for score in last.scores)
    late = _compared(last, max(least, _LEFT if found.terms else 0.0), floor)
    return replace(late, after=tuple(term.group.label for term in found.terms))


def _compared(screen: Screen, least: float, floor: float) -> Outside:
    told, gains = screen.flexible.told, screen.flexible.gains
    best = max(gains, key=lambda name: gains[name])
    library = max(score.gain for score in screen.scores)
    fall = screen.flexible.null - told[best].misfit
    sure = fall.sum() > _SURE * np.sqrt((fall**2).sum())
    beats = gains[best] > max(least, screen.needed, OVER_BASE * floor) and sure
    return Outside(gains, library, best, bool(beats), told[best].change, told[best].beat)
