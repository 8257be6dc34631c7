"""What flexible forces, which belong to no effect, take away of a misfit."""

from __future__ import annotations

import numpy as np

from caphy.diagnose.probes import probe_places
from caphy.refit.evidence import Evidence, ridged

RIDGE = 1e-2
"""Shrinks the many pressures of a probe."""


def flexible_misfits(known: Evidence) -> dict[str, np.ndarray]:
    """chi2 of each window (W,) for each probe, fitted to all the other windows."""
    return {name: _left_out(known.picked(place)) for name, place in probe_places().items() if known.b[:, place].any()}


def flexible_gains(known: Evidence) -> dict[str, float]:
    """Share of the misfit that each probe takes away in windows left out of its fit."""
    null = known.misfit(np.zeros(known.b.shape[1])).sum()
    return {name: 1 - float(misfit.sum() / null) for name, misfit in flexible_misfits(known).items()}


def _left_out(known: Evidence) -> np.ndarray:
    normal, right = known.normal
    fits = [
        ridged(normal - w * a, right - w * b, RIDGE) for w, a, b in zip(known.weight, known.a, known.b, strict=True)
    ]
    return known.misfit(np.array(fits))
