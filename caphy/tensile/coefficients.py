"""Numbers of a fit with intervals, from loadings that could have come out otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from caphy.tensile.between import contrasts, learned
from caphy.tensile.fit import Fit
from caphy.tensile.null import drawn, freedom

_DRAWS = 400


@dataclass(frozen=True)
class Coefficient:
    """One number of one fabric: value, 95 % interval between repeats, unit.

    ``shared``: the share of its response that no other number gives; the smaller the less it means on its own.
    """

    fabric: str
    effect: str
    name: str
    value: float
    interval: tuple[float, float]
    unit: str
    used: bool
    own_share: float


def coefficients(fits: Mapping[str, Fit]) -> list[Coefficient]:
    """All numbers of the fits of each fabric."""
    return [row for fabric, fit in fits.items() for row in (*_common(fabric, fit), *_of_used(fabric, fit))]


def _common(fabric: str, fit: Fit) -> list[Coefficient]:
    if not fit.numbers:
        return []
    slopes = fit.slopes.reshape(-1, len(fit.numbers))
    random, wide = np.random.default_rng(0), _t_over_normal(fit)
    scale = np.sqrt((slopes**2).sum(0)) + 1e-300
    inverse = np.linalg.pinv(slopes / scale, rcond=1e-8) / scale[:, None]
    draws = np.stack([inverse @ drawn(fit.bench, random).reshape(-1) for _ in range(_DRAWS)])
    low, high = np.quantile(wide * draws, (0.025, 0.975), axis=0)
    rows = []
    for k, number in enumerate(fit.numbers):
        value, bounds = float(fit.values[k]), number.bounds
        interval = float(np.clip(value + low[k], *bounds)), float(np.clip(value + high[k], *bounds))
        share = _own_share(slopes, k)
        rows.append(Coefficient(fabric, number.effect, number.name, value, interval, number.unit, False, share))
    return rows


def _t_over_normal(fit: Fit) -> float:
    """Few repeats know their scatter badly: Student's quantile over the normal one."""
    from scipy.stats import t

    free = sum(freedom(test) for test in fit.bench.tests)
    return float(t.ppf(0.975, max(free, 1)) / 1.96)


def _own_share(slopes: np.ndarray, k: int) -> float:
    others = np.delete(slopes, k, axis=1)
    column = slopes[:, k]
    if not others.shape[1]:
        return 1.0
    left = column - others @ np.linalg.lstsq(others, column, rcond=1e-9)[0]
    return float((left @ left) / max(column @ column, 1e-300))


def _of_used(fabric: str, fit: Fit) -> list[Coefficient]:
    from scipy.stats import t

    if not fit.bench.held:
        return []
    numbers = tuple(number for number, _ in fit.bench.held)
    rows = contrasts({fabric: fit}, numbers)
    if not rows:
        return []
    _, errors = learned(rows)
    wide = float(t.ppf(0.975, max(sum(len(row.stack) - 2 for row in rows), 1)))
    found = []
    for (number, value), error, (low, high) in zip(fit.bench.held, errors, rows[0].bounds, strict=True):
        interval = float(max(value - wide * error, low)), float(min(value + wide * error, high))
        found.append(Coefficient(fabric, number.effect, number.name, value, interval, number.unit, True, 1.0))
    return found
