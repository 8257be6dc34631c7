"""What tensile tests of a model that is right would look like: scatter between repeats and nothing else."""

from __future__ import annotations

import numpy as np

from caphy.tensile.fit import Bench, Fit
from caphy.tensile.loadings import Tests, repeats_of, rows_of

DRAWS = 200
_SAFETY = 2.0  # on the null's 99 %, which few repeats know badly
_LEAST = 1.0  # where repeats agree better than the smallest scatter that is counted with


def outside(fit: Fit) -> bool:
    """Whether a model is further from the tests than scatter would have it."""
    return systematic(fit.bench, fit.residual) > chance(fit.bench)


def systematic(bench: Bench, residual: np.ndarray) -> float:
    """Mean square of what loadings of one direction and history have in common (1 if it is scatter)."""
    total, entries = 0.0, 0
    for rows in _alike(bench):
        mean = residual[rows].mean(0)
        total += len(rows) * float((mean**2).sum())
        entries += int(np.count_nonzero(residual[rows].any(0)))
    return total / max(entries, 1)


def _alike(bench: Bench) -> list[list[int]]:
    """Loadings of the same direction and history."""
    groups: dict[tuple[str, bool], list[int]] = {}
    for i, (test, loading) in enumerate(rows_of(bench.tests)):
        groups.setdefault((test.direction, loading.used), []).append(i)
    return list(groups.values())


def chance(bench: Bench) -> float:
    """What :func:`systematic` stays below where a model is right."""
    random = np.random.default_rng(1)
    draws = [systematic(bench, drawn(bench, random)) for _ in range(DRAWS)]
    return max(_LEAST, _SAFETY * float(np.quantile(draws, 0.99)))


def drawn(bench: Bench, random: np.random.Generator) -> np.ndarray:
    """What repeats differ by, drawn anew for every loading, over their scatter (L, 2, B)."""
    rows = []
    for test in bench.tests:
        off = deviations(test)
        rows.append(off[random.integers(0, len(off), len(test.loadings))])
    return np.concatenate(rows)


def deviations(test: Tests) -> np.ndarray:
    """Repeats less their mean over their scatter (n, 2, B), widened for the freedom that the mean took; 0 unmeasured.

    Where there are no repeats, independent draws stand for them.
    """
    repeats = repeats_of(test.loadings)
    if len(repeats) < 2:
        return np.random.default_rng(0).normal(size=(8, 2, 1)) * np.isfinite(test.loadings[0].measured)
    stack = np.stack([loading.measured for loading in repeats]) / test.scatter
    count = np.maximum(np.isfinite(stack).sum(0), 1)
    off = np.nan_to_num(stack - np.nansum(stack, 0) / count)
    return off * np.sqrt(len(repeats) / (len(repeats) - 1))


def freedom(test: Tests) -> int:
    """Degrees of freedom that the scatter of a test's repeats is known by; 0 where there are none."""
    return len(repeats_of(test.loadings)) - 1
