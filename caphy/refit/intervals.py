"""How sure fitted numbers are: windows resampled, not residuals, because what a window misses it misses throughout."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from caphy.refit.evidence import Evidence, ridged

REPLICAS = 500
LEVEL = 0.95
"""Of the intervals."""


def deviations(known: Evidence, seed: int = 0) -> np.ndarray:
    """Deviations (R, K) of the estimate in windows drawn again with replacement (Efron 1979)."""
    random = np.random.default_rng(seed)
    many = len(known.c)
    normal, right = known.normal
    best = ridged(normal, right, 1e-9)
    found = []
    for _ in range(REPLICAS):
        drawn = known.weight * np.bincount(random.integers(many, size=many), minlength=many)
        a, b = np.einsum("w,wkl->kl", drawn, known.a), drawn @ known.b
        found.append(ridged(a, b, 1e-6) - best)
    return np.array(found).reshape(REPLICAS, -1)


def half_widths(known: Evidence, seed: int = 0) -> np.ndarray:
    """Half widths (K,) of the :data:`LEVEL` intervals.

    The spread of the bootstrap, widened by Student's t with as many degrees of freedom as there are windows left over:
    a dozen windows know their own spread only roughly.
    """
    spread = deviations(known, seed).std(axis=0)
    free = max(int((known.weight > 0.05).sum()) - known.b.shape[1], 2)
    return student.ppf(0.5 + LEVEL / 2, free) * spread * np.sqrt(1 + 1 / free)
