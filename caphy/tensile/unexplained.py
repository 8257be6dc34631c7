"""What tensile tests show that a fitted model does not say: whether it is more than scatter, and what it depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from caphy.tensile.fit import Fit
from caphy.tensile.loadings import Tests, rows_of
from caphy.tensile.null import systematic

_PARTS = (("small", 0, 8), ("middle", 8, 16), ("large", 16, 24))
_LEAST_LOADINGS, _STEADY = 4, 0.9  # loadings, and correlation of force with their number, for a drift
_LEAST = 0.05  # of the force, to be worth a sentence
_SCATTER = 1.0  # of what is systematic, where it is scatter


@dataclass(frozen=True)
class Dependence:
    """What the residual of force depends on: share of its variance that means over each covariate explain.

    ``sentences`` name the largest parts in words.
    """

    shares: Mapping[str, float]
    sentences: tuple[str, ...]


def dependence(fits: Mapping[str, Fit]) -> Dependence:
    """Covariates of the residual over all fabrics."""
    pieces = [
        (fabric, test, loading, fit.residual[i, 0])
        for fabric, fit in fits.items()
        for i, (test, loading) in enumerate(rows_of(fit.bench.tests))
    ]
    order = list(fits)
    columns = {
        "strain": [np.arange(len(x.force)) for _, _, x, _ in pieces],
        "direction": [np.full(len(x.force), t.direction == "warp") for _, t, x, _ in pieces],
        "fabric": [np.full(len(x.force), order.index(f)) for f, _, x, _ in pieces],
        "loading number": [np.full(len(x.force), x.curve.loading) for _, _, x, _ in pieces],
    }
    flat = {name: np.concatenate(column).astype(int) for name, column in columns.items()}
    together = {
        "strain and direction": flat["strain"] + 1000 * flat["direction"],
        "strain, direction and fabric": flat["strain"] + 1000 * flat["direction"] + 10000 * flat["fabric"],
    }
    values = np.concatenate([r for *_, r in pieces])
    shares = {name: _explained(group, values) for name, group in {**flat, **together}.items()}
    return Dependence(shares, tuple(_sentences(fits)))


def _explained(group: np.ndarray, values: np.ndarray) -> float:
    """Share of the squares that group means explain, corrected for their number."""
    _, place = np.unique(group, return_inverse=True)
    count = np.bincount(place)
    mean = np.bincount(place, values) / count
    left, whole = float(((values - mean[place]) ** 2).sum()), float((values**2).sum())
    free = max(len(values) - len(count), 1)
    return 1 - (left / free) / max(whole / len(values), 1e-300)


def _sentences(fits: Mapping[str, Fit]) -> list[str]:
    said: list[tuple[float, str]] = []
    for fit in fits.values():
        at = 0
        for test in fit.bench.tests:
            rows = range(at, at + len(test.loadings))
            at += len(test.loadings)
            parts = _parts(test, fit.residual[list(rows), 0] * test.scatter[0])
            if parts:
                worst = max(abs(share) for _, share in parts)
                words = ", ".join(
                    f"{100 * abs(share):.0f} % too {'soft' if share > 0 else 'stiff'} at {name} strains"
                    for name, share in parts
                )
                said.append((worst, f"{test.name}: the model is {words}."))
    return [sentence for _, sentence in sorted(said, reverse=True)]


def _parts(test: Tests, error: np.ndarray) -> list[tuple[str, float]]:
    """Thirds of strain in which loadings agree that the model is off, with the error over the force there."""
    force = np.stack([loading.force for loading in test.loadings])
    found = []
    for name, start, stop in _PARTS:
        seen = np.isfinite(force[:, start:stop])
        some = seen.any(1)
        if not some.any():
            continue
        each = (error[:, start:stop] * seen).sum(1)[some] / seen.sum(1)[some]
        share = float(each.mean() / force[:, start:stop][seen].mean())
        sure = len(each) > 1 and abs(each.mean()) > 2 * each.std(ddof=1) / np.sqrt(len(each))
        if abs(share) > _LEAST and sure:
            found.append((name, share))
    return found


def share_left(fits: Mapping[str, Fit], before: Mapping[str, Fit]) -> float:
    """What is left of the systematic misfit beyond chance, as a share of what there was before; mean over fabrics."""
    shares = []
    for fabric, fit in fits.items():
        first = systematic(before[fabric].bench, before[fabric].residual) - _SCATTER
        left = systematic(fit.bench, fit.residual) - _SCATTER
        if first > 0:
            shares.append(max(left, 0.0) / first)
    return float(np.mean(shares)) if shares else 0.0


def drift(fits: Mapping[str, Fit]) -> float | None:
    """Relative change of force from one loading to the next, where it goes one way in all directions of all fabrics.

    At strains that all loadings reach: the mean of one that is pulled further is larger under the same law.
    """
    slopes: list[float] = []
    for fit in fits.values():
        for test in fit.bench.tests:
            if len(test.loadings) < _LEAST_LOADINGS:
                continue
            forces = np.stack([loading.force for loading in test.loadings])
            shared = np.isfinite(forces).all(axis=0)
            if not shared.any():
                continue
            force = forces[:, shared].mean(axis=1)
            number = np.array([loading.curve.loading for loading in test.loadings], dtype=float)
            if not np.ptp(force[1:]) or not abs(np.corrcoef(number[1:], force[1:])[0, 1]) > _STEADY:
                return None
            slopes.append(float(np.polyfit(number, np.log(np.maximum(force, 1e-9)), 1)[0]))
    if not slopes or min(map(abs, slopes)) < _LEAST or min(slopes) * max(slopes) < 0:
        return None
    return float(np.expm1(np.mean(slopes)))
