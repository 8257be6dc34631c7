"""Medians, percentiles and contrasts of errors, with uncertainty that respects restarts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

MILLI = 1e3
_RESAMPLES = 200
_LEAST_WINDOWS = 4


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
    values = np.broadcast_to(values, distance.shape)
    good = np.isfinite(values) & np.isfinite(distance)
    if not good.any():
        return None
    low, high = np.quantile(values[good], (0.5, 0.75))
    if low >= high:
        return None
    masks = [good & (values > high), good & (values <= low)]
    if min(len(np.unique(window[np.nonzero(mask)[0]])) for mask in masks) < _LEAST_WINDOWS:
        return None

    def difference(rows: np.ndarray) -> float:
        above, below = (distance[rows][mask[rows]] for mask in masks)
        return MILLI * float(np.median(above) - np.median(below)) if len(above) and len(below) else np.nan

    return {
        "low": float(low),
        "high": float(high),
        "below_mm": summary(distance[masks[1]])["median_mm"],
        "above_mm": summary(distance[masks[0]])["median_mm"],
        "difference_mm": difference(np.arange(len(distance))),
        "interval_mm": interval(difference, window),
    }


def interval(statistic: Callable[[np.ndarray], float], window: np.ndarray) -> tuple[float, float]:
    """90 % interval of a statistic of rows, by a bootstrap over windows (Efron 1979)."""
    random, groups = np.random.default_rng(0), [np.flatnonzero(window == w) for w in np.unique(window)]
    draws = [
        statistic(np.concatenate([groups[i] for i in random.integers(0, len(groups), len(groups))]))
        for _ in range(_RESAMPLES)
    ]
    low, high = np.nanquantile(draws, (0.05, 0.95))
    return float(low), float(high)
