"""Does a force that belongs to no effect explain what is left? Then the answer is what it depends on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.diagnose.probes import probe_places
from caphy.diagnose.search import OVER_BASE, Search
from caphy.refit.evidence import Evidence, ridged

_RIDGE = 1e-2
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
    places = probe_places()
    left = {name: _left_out(known.picked(place)) for name, place in places.items() if known.b[:, place].any()}
    null = known.misfit(np.zeros(known.b.shape[1]))
    gains = {name: 1 - float(misfit.sum() / null.sum()) for name, misfit in left.items()}
    best = max(gains, key=lambda name: gains[name])
    library = max(score.gain for score in last.scores)
    fall = null - left[best]
    sure = fall.sum() > _SURE * np.sqrt((fall**2).sum())
    beats = gains[best] > max(_MORE * library, last.needed, OVER_BASE * floor) and sure
    return Outside(gains, library, best, bool(beats), ridged(*known.picked(places[best]).normal, _RIDGE))


def _left_out(known: Evidence) -> np.ndarray:
    """chi2 of each window (W,) with a probe fitted to all the others."""
    normal, right = known.normal
    fits = [
        ridged(normal - w * a, right - w * b, _RIDGE) for w, a, b in zip(known.weight, known.a, known.b, strict=True)
    ]
    return known.misfit(np.array(fits))
