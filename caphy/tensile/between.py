"""What the first loading has that repeats have not: the same strip, so the rest of the model cancels.

In each direction the mean of the repeats less the first loading is compared with what an effect that acts from the
second loading on would change. Learned from one direction, foretold in the other; by chance, any loading could differ
from the others as the first one does, so the null exchanges the first loading with a repeat.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caphy.tensile.fit import Fit
from caphy.tensile.loadings import Tests
from caphy.tensile.numbers import Number, added
from caphy.tensile.search import Ranked

LEAST_GAIN = 0.1
CHANCE = 0.05
_EXCHANGES = 400
TOO_FEW = (
    "There are too few loadings to tell what the first one has that repeats have not: by chance any of them may differ "
    "as much; load each strip five times in each direction, or more strips."
)
"""What is said where no gain would be beyond chance."""


@dataclass(frozen=True, eq=False)
class Contrast:
    """Tests of one direction seen loading by loading.

    Attributes:
        stack: force and transverse strain over their scatter (L, 2 B), 0 where unmeasured anywhere.
        first: which loading is the first.
        response: what each number of used cloth changes, the same way (2 B, K).
        bounds: how far each may be changed (K, 2).
    """

    fabric: str
    stack: np.ndarray
    first: int
    response: np.ndarray
    bounds: np.ndarray

    def difference(self, first: int | None = None) -> np.ndarray:
        """Mean of the other loadings less one loading (2 B,), over what it is known to."""
        one = self.first if first is None else first
        others = np.delete(np.arange(len(self.stack)), one)
        return (self.stack[others].mean(0) - self.stack[one]) / np.sqrt(1 + 1 / len(others))


def contrasts(fits: dict[str, Fit], numbers: Sequence[Number]) -> list[Contrast]:
    """One for each direction of each fabric that has a first loading and two repeats or more."""
    found = []
    for fabric, fit in fits.items():
        values = np.concatenate([fit.values, [number.start(fit.bench.model) for number in numbers]])
        slopes = fit.bench.slopes((*fit.numbers, *numbers), values)[..., len(fit.values) :]
        model, at = fit.models[0], 0
        bounds = np.array([np.subtract(n.bounds, n.start(model)) for n in numbers])
        for test in fit.bench.tests:
            part = slopes[at : at + len(test.loadings)]
            at += len(test.loadings)
            if (row := _contrast(fabric, test, part, bounds)) is not None:
                found.append(row)
    return found


def _contrast(fabric: str, test: Tests, slopes: np.ndarray, bounds: np.ndarray) -> Contrast | None:
    used = [loading.used for loading in test.loadings]
    if sum(used) < 2 or all(used):
        return None
    stack = np.stack([loading.measured for loading in test.loadings]) / test.scatter
    known = np.asarray(np.isfinite(stack).all(axis=0))
    response = slopes[used].mean(0) * known[..., None] / np.sqrt(1 + 1 / sum(used))
    flat = np.where(known, stack, 0.0).reshape(len(stack), -1)
    return Contrast(fabric, flat, used.index(False), response.reshape(flat.shape[1], -1), bounds)


def between_loadings(fits: dict[str, Fit], candidates: Sequence[str]) -> list[Ranked]:
    """Candidates that act from the second loading on, best first; empty where there is no first loading to compare."""
    sets = {name: contrasts(fits, added(name, used=True)) for name in candidates}
    if not sets or not all(sets.values()):
        return []
    gains = {name: _gain(rows, [row.first for row in rows]) for name, rows in sets.items()}
    threshold = max(_threshold(list(sets.values())), LEAST_GAIN)
    ranked = [
        Ranked(name, _mean(gain), gain, threshold, used=True, count=len(added(name, used=True)))
        for name, gain in gains.items()
    ]
    return sorted(ranked, key=lambda row: -row.gain)


def learned(rows: Sequence[Contrast]) -> tuple[np.ndarray, np.ndarray]:
    """Values (K,) that the contrasts of one fabric agree on best, and their standard errors (K,).

    The error is from the scatter between repeats, as if whole curves were shifted: one observation per direction.
    """
    normal = [row.response.T @ row.response for row in rows]
    right = [row.response.T @ row.difference() for row in rows]
    values = _solved(normal, right, rows[0].bounds)
    inverse = np.linalg.pinv(sum(normal), rcond=1e-8)
    spread = np.zeros_like(inverse)
    for row in rows:
        for one in range(len(row.stack)):
            if one != row.first:
                others = [k for k in range(len(row.stack)) if k not in (one, row.first)]
                off = (row.stack[one] - row.stack[others].mean(0)) / np.sqrt(1 + 1 / len(others))
                pushed = row.response.T @ off
                spread += np.outer(pushed, pushed) / (len(row.stack) - 1)
    return values, np.sqrt(np.diag(inverse @ spread @ inverse))


def _solved(normal: Sequence[np.ndarray], right: Sequence[np.ndarray], bounds: np.ndarray) -> np.ndarray:
    whole = np.sum(normal, axis=0)
    return np.clip(np.linalg.pinv(whole, rcond=1e-8) @ np.sum(right, axis=0), bounds[:, 0], bounds[:, 1])


def _mean(gains: dict[str, float]) -> float:
    return float(np.mean(list(gains.values())))


def _threshold(sets: Sequence[Sequence[Contrast]]) -> float:
    """Gain that the best candidate must exceed for a chance below :data:`CHANCE` (Fisher's exact test); infinite where
    there are too few loadings for any."""
    rows = sets[0]
    true = tuple(row.first for row in rows)
    count = int(np.prod([len(row.stack) for row in rows], dtype=float))
    if count <= _EXCHANGES:
        exchanges = list(itertools.product(*(range(len(row.stack)) for row in rows)))
    else:
        random = np.random.default_rng(0)
        exchanges = [tuple(int(random.integers(len(row.stack))) for row in rows) for _ in range(_EXCHANGES)]
    others = [first for first in exchanges if first != true]
    above = int(CHANCE * (len(others) + 1)) - 1
    if above < 0:
        return float("inf")
    gains = sorted((max(_mean(_gain(some, first)) for some in sets) for first in others), reverse=True)
    return gains[above]


def _gain(rows: Sequence[Contrast], first: Sequence[int]) -> dict[str, float]:
    """Fall of the squared difference that numbers learned from the fabric's other direction foretell, by fabric, where
    loading ``first`` of each is set against the others; as a share of the difference of the true first loadings.

    Where a fabric has one direction, from other fabrics; where there is only one test, from that test itself.
    """
    differences = [row.difference(k) for row, k in zip(rows, first, strict=True)]
    normal = [row.response.T @ row.response for row in rows]
    right = [row.response.T @ d for row, d in zip(rows, differences, strict=True)]
    fall, whole = (dict.fromkeys([row.fabric for row in rows], 0.0) for _ in range(2))
    for i, row in enumerate(rows):
        others = [j for j, other in enumerate(rows) if j != i and other.fabric == row.fabric]
        others = others or [j for j in range(len(rows)) if j != i] or [i]
        values = _solved([normal[j] for j in others], [right[j] for j in others], row.bounds)
        error, true = differences[i] - row.response @ values, row.difference()
        fall[row.fabric] += float(differences[i] @ differences[i] - error @ error)
        whole[row.fabric] += float(true @ true)
    return {fabric: fall[fabric] / max(whole[fabric], 1e-12) for fabric in fall}
