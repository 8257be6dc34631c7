"""Medians, percentiles and contrasts of errors, with uncertainty that respects restarts."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

MILLI = 1e3
_RESAMPLES = 200
_LEAST_WINDOWS = 4
_ALL_SIGNS = 12  # windows up to which every pattern of signs is tried; of more, as many at random


def summary(distance: np.ndarray) -> dict[str, float | int | None]:
    """Median and 95th percentile [mm] of errors [m] of any shape, NaN left out, and how many there are."""
    found = distance[np.isfinite(distance)]
    if len(found) == 0:
        return {"median_mm": None, "p95_mm": None, "count": 0}
    middle, high = np.quantile(found, (0.5, 0.95))
    return {"median_mm": MILLI * float(middle), "p95_mm": MILLI * float(high), "count": len(found)}


def mean_mm(values: np.ndarray) -> float | None:
    """Mean [mm] of signed errors [m], NaN left out."""
    found = values[np.isfinite(values)]
    return MILLI * float(found.mean()) if len(found) else None


def binned(values: np.ndarray, distance: np.ndarray, bins: int = 6) -> list[dict]:
    """Errors (N, V) [m] in bins of equal numbers of a covariate, (N, V) or (N, 1)."""
    values = np.broadcast_to(values, distance.shape)
    good = np.isfinite(values) & np.isfinite(distance)
    if not good.any():
        return []
    edges = np.unique(np.quantile(values[good], np.linspace(0, 1, bins + 1)))
    if len(edges) < 2:
        return []
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return [
        {"low": float(edges[b]), "high": float(edges[b + 1]), **summary(distance[good & (place == b)])}
        for b in range(len(edges) - 1)
    ]


def contrast(values: np.ndarray, distance: np.ndarray, window: np.ndarray) -> dict | None:
    """Median error [mm] where a covariate is in its top quarter against its lower half, with a 90 % interval.

    The interval comes from a bootstrap over windows: rows of one window share their start and are not independent.
    None where fewer than four windows hold both.
    """
    if (found := _halves(values, distance, window)) is None:
        return None
    low, high, *masks = found

    def difference(rows: np.ndarray) -> float:
        above, below = (distance[rows][mask[rows]] for mask in masks)
        return MILLI * float(np.median(above) - np.median(below)) if len(above) and len(below) else np.nan

    return {
        "low": low,
        "high": high,
        "below_mm": summary(distance[masks[1]])["median_mm"],
        "above_mm": summary(distance[masks[0]])["median_mm"],
        "difference_mm": difference(np.arange(len(distance))),
        "interval_mm": interval(difference, window),
    }


def chances(covariates: Sequence[np.ndarray], distance: np.ndarray, window: np.ndarray) -> list[float | None]:
    """How often chance alone makes the best of all covariates as good as each, by the contrast of its halves.

    One number for each covariate, (N, V) or (N, 1), none where :func:`contrast` has none. Each window says by how much
    more often errors lie above the common median where the covariate is large; without an effect its sign is a coin's
    (Kline and Santos, A score based approach to wild bootstrap inference, 2012). The largest studentised sum of all
    covariates is what each is held against, since the best of many is large by chance (Westfall and Young 1993).
    """
    scores = [_scores(values, distance, window) for values in covariates]
    held = [score for score in scores if score is not None]
    if not held:
        return [None] * len(scores)
    units = np.stack([score / max(float(np.linalg.norm(score)), 1e-300) for score in held], axis=1)  # (W, C)
    best = (_signs(len(units)) @ units).max(axis=1)
    told = iter([float((best >= size - 1e-9).mean()) for size in units.sum(axis=0)])
    return [None if score is None else next(told) for score in scores]


def _signs(count: int) -> np.ndarray:
    """Patterns of signs (P, count), the first all positive: all that there are, or many at random."""
    if count <= _ALL_SIGNS:
        return 1.0 - 2.0 * (np.arange(2**count)[:, None] >> np.arange(count) & 1)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (2**_ALL_SIGNS, count))
    signs[0] = 1
    return signs


def _scores(values: np.ndarray, distance: np.ndarray, window: np.ndarray) -> np.ndarray | None:
    """What each window (W,) adds to the difference of how often errors above and below exceed their common median."""
    if (found := _halves(values, distance, window)) is None:
        return None
    masks = found[2:]
    middle = np.median(distance[masks[0] | masks[1]])
    sign = np.sign(distance - middle)
    above, below = (np.where(mask, sign, 0).sum(axis=1) / mask.sum() for mask in masks)
    return np.bincount(np.unique(window, return_inverse=True)[1], above - below)


def _halves(
    values: np.ndarray, distance: np.ndarray, window: np.ndarray
) -> tuple[float, float, np.ndarray, np.ndarray] | None:
    """Median and upper quartile of a covariate, and which errors (N, V) lie above the latter and up to the former."""
    values = np.broadcast_to(values, distance.shape)
    good = np.isfinite(values) & np.isfinite(distance)
    if not good.any():
        return None
    low, high = np.quantile(values[good], (0.5, 0.75))
    if low >= high:
        return None
    above, below = good & (values > high), good & (values <= low)
    if min(len(np.unique(window[np.nonzero(mask)[0]])) for mask in (above, below)) < _LEAST_WINDOWS:
        return None
    return float(low), float(high), above, below


def interval(statistic: Callable[[np.ndarray], float], window: np.ndarray) -> tuple[float, float]:
    """90 % interval of a statistic of rows, by a bootstrap over windows (Efron 1979)."""
    random, groups = np.random.default_rng(0), [np.flatnonzero(window == w) for w in np.unique(window)]
    draws = [
        statistic(np.concatenate([groups[i] for i in random.integers(0, len(groups), len(groups))]))
        for _ in range(_RESAMPLES)
    ]
    low, high = np.nanquantile(draws, (0.05, 0.95))
    return float(low), float(high)
