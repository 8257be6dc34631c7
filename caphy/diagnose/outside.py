"""Does a force that belongs to no effect explain more than the library? Then the answer is what it depends on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.diagnose.probes import probe_places
from caphy.diagnose.search import Search
from caphy.refit.evidence import Evidence, ridged

_RIDGE = 1e-2
_MORE = 0.2  # share of its own gain by which a probe must beat the library
_SURE = 2.0  # standard errors of the difference over windows


@dataclass(frozen=True)
class Outside:
    """What flexible forces explain.

    Attributes:
        gains: share of the misfit that each probe takes away in windows left out of its fit.
        library: the same for the library's best, refitted.
        best: the best probe.
        beats: it explains so much more than the library that the library has no name for what is missing.
        change: pressures (K,) [Pa] of the best probe.
    """

    gains: dict[str, float]
    library: float
    best: str
    beats: bool
    change: np.ndarray


def outside(found: Search) -> Outside:
    """Fit the probes to what the model as it was leaves, and compare them with the library."""
    first = found.screens[0]
    known = first.evidence_of_probes
    places = probe_places()
    left = {name: _left_out(known.picked(place)) for name, place in places.items() if known.b[:, place].any()}
    null = known.misfit(np.zeros(known.b.shape[1]))
    gains = {name: 1 - float(misfit.sum() / null.sum()) for name, misfit in left.items()}
    best = max(gains, key=lambda name: gains[name])
    library, by_library = _library(found, null)
    lead = by_library - left[best]
    sure = lead.sum() > _SURE * np.sqrt((lead**2).sum())
    beats = gains[best] > max(library + _MORE * gains[best], first.needed) and sure
    return Outside(gains, library, best, bool(beats), ridged(*known.picked(places[best]).normal, _RIDGE))


def _left_out(known: Evidence) -> np.ndarray:
    """chi2 of each window (W,) with a probe fitted to all the others."""
    normal, right = known.normal
    fits = [
        ridged(normal - w * a, right - w * b, _RIDGE) for w, a, b in zip(known.weight, known.a, known.b, strict=True)
    ]
    return known.misfit(np.array(fits))


def _library(found: Search, null: np.ndarray) -> tuple[float, np.ndarray]:
    """Gain of the library's best, and the chi2 it leaves in each window (W,)."""
    if found.fit is not None:
        left = found.fit.evidence.weight * found.fit.evidence.c
        return 1 - float(left.sum() / null.sum()), left
    first = found.screens[0]
    best = first.scores[0]
    picked = first.evidence.picked(first.places[best.group.label])
    left = picked.misfit(best.change)
    return best.gain, left
