"""Does a force that belongs to no effect explain what is left? Then the answer is what it depends on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.diagnose.flexible import RIDGE, flexible_gains, flexible_misfits
from caphy.diagnose.probes import probe_places
from caphy.diagnose.search import OVER_BASE, Search
from caphy.refit.evidence import ridged

_MORE = 1.5  # times the library's best gain that a probe must reach
_SURE = 2.0  # standard errors over windows


@dataclass(frozen=True)
class Outside:
    """What flexible forces explain of what is left after everything that was accepted.

    Attributes:
        gains: share of the misfit that each probe takes away in windows left out of its fit.
        library: the same for the best of what is left of the library.
        best: the best probe.
        beats: it explains so much more that something acts for which the library has no name.
        change: pressures (K,) [Pa] of the best probe.
    """

    gains: dict[str, float]
    library: float
    best: str
    beats: bool
    change: np.ndarray


def outside(found: Search, floor: float = 0.0) -> Outside:
    """Fit the probes to what is left, and compare them with what is left of the library.

    Args:
        floor: best gain of the probes on base measurements, where nothing is missing.
    """
    last = found.screens[-1]
    known = last.evidence_of_probes
    left, gains = flexible_misfits(known), flexible_gains(known)
    best = max(gains, key=lambda name: gains[name])
    library = max(score.gain for score in last.scores)
    fall = known.misfit(np.zeros(known.b.shape[1])) - left[best]
    sure = fall.sum() > _SURE * np.sqrt((fall**2).sum())
    beats = gains[best] > max(_MORE * library, last.needed, OVER_BASE * floor) and sure
    return Outside(gains, library, best, bool(beats), ridged(*known.picked(probe_places()[best]).normal, RIDGE))
