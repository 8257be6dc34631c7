"""Loadings of tensile tests made ready to be compared: checked, binned over strain, with the scatter of repeats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from caphy.errors import CaphyError
from caphy.io.measurements import ForceCurve
from caphy.tensile.checks import usable
from caphy.tensile.strip import NODES

BINS = 24
"""Of strain, in each loading."""
LEAST_FORCE, LEAST_STRAIN = 0.01, 0.01
"""Smallest scatter: of force as a share of the largest, of transverse strain."""
_FARTHER = 1.1  # times the strain that half of the loadings reach: what is said to be left out
_FIRST = 0.01  # of the largest strain: where the first bin starts


@dataclass(frozen=True, eq=False)
class Loading:
    """One loading in B bins of strain.

    Attributes:
        curve: as measured.
        strain, force, transverse: means of each bin (B,) [1], [N/m], [1]; NaN where a bin is empty or unmeasured.
        average: what turns a model's values at the nodes of its strip into means over the same samples (B, N).
    """

    curve: ForceCurve
    strain: np.ndarray
    force: np.ndarray
    transverse: np.ndarray
    average: np.ndarray

    @property
    def used(self) -> bool:
        """Whether this strip was loaded before."""
        return self.curve.loading > 1

    @property
    def measured(self) -> np.ndarray:
        """Force and transverse strain, (2, B)."""
        return np.stack([self.force, self.transverse])


@dataclass(frozen=True, eq=False)
class Tests:
    """All loadings of one fabric in one direction.

    Attributes:
        axial: strains at which a model's curve is evaluated (N,).
        scatter: standard deviation between repeats (2, B): force [N/m], transverse strain.
    """

    fabric: str
    direction: str
    axial: np.ndarray
    loadings: tuple[Loading, ...]
    scatter: np.ndarray

    @property
    def name(self) -> str:
        return f"{self.fabric.replace('_', ' ')}, {self.direction}"

    @property
    def reached(self) -> float:
        """Largest energy per area of the loadings [N/m], which is what cloth remembers: the area under the curve."""
        curves = [loading.curve for loading in self.loadings]
        return float(max(1e-3, *(np.trapezoid(c.force, c.axial) for c in curves)))

    def picked(self, wanted: Callable[[ForceCurve], bool]) -> Tests:
        """Only the loadings whose curves are wanted."""
        kept = tuple(loading for loading in self.loadings if wanted(loading.curve))
        return Tests(self.fabric, self.direction, self.axial, kept, self.scatter)


Fabrics = dict[str, list[Tests]]
"""The tests of each fabric."""


def rows_of(tests: Sequence[Tests]) -> list[tuple[Tests, Loading]]:
    """Loadings in the order of residuals."""
    return [(test, loading) for test in tests for loading in test.loadings]


def prepared(curves: Sequence[ForceCurve], held_out: Sequence[ForceCurve] = ()) -> tuple[Fabrics, list[str]]:
    """Tests by fabric, and what was left out or doubtful in sentences; raises :class:`CaphyError` on bad input.

    How far strains are looked at, and how much repeats scatter, is told by ``curves``; by those ``held_out`` only where
    there is no other of their fabric and direction, or no other repeats at all.
    """
    kept, cautions = usable([*curves, *held_out])
    away = {curve.name for curve in held_out}
    groups: dict[tuple[str, str], list[ForceCurve]] = {}
    for curve in kept:
        groups.setdefault((curve.fabric, curve.direction), []).append(curve)
    telling = {key: [curve for curve in part if curve.name not in away] or part for key, part in groups.items()}
    shares = _shares(telling.values()) or _shares(groups.values())
    if not shares:
        raise CaphyError(
            f"{kept[0].source or 'force curves'}: at least one fabric needs two or more loadings of one direction: "
            "without repeats nobody can tell an effect from scatter; number them 1, 2, ... in the column loading"
        )
    fabrics: Fabrics = {}
    for (fabric, direction), part in groups.items():
        tests = _tests(fabric, direction, part, telling[fabric, direction], float(np.median(shares)))
        short = [loading.curve.name for loading in tests.loadings if not np.isfinite(loading.force).any()]
        cautions += [*_beyond(tests, part), *_before(tests, short)]
        fabrics.setdefault(fabric, []).append(tests.picked(lambda curve, short=short: curve.name not in short))
    return fabrics, cautions


def _beyond(tests: Tests, curves: Sequence[ForceCurve]) -> list[str]:
    """What is said where loadings are pulled much farther than most, which have nothing to say there."""
    top = float(tests.axial[-1])
    far = [curve.name for curve in curves if curve.axial.max() > _FARTHER * top]
    if not far:
        return []
    return [
        f"{', '.join(far)} {'goes' if len(far) == 1 else 'go'} beyond the strain of {100 * top:.3g} % "
        "that half of the loadings reach; rows beyond it are left out, so that nothing is said of what they show."
    ]


def _before(tests: Tests, short: Sequence[str]) -> list[str]:
    """What is said of loadings that end before the first bin, which are left out."""
    if not short:
        return []
    return [
        f"{', '.join(short)} {'ends' if len(short) == 1 else 'end'} before a strain of "
        f"{100 * _FIRST * float(tests.axial[-1]):.2g} %, where the others are looked at; left out."
    ]


def _tests(
    fabric: str, direction: str, curves: Sequence[ForceCurve], telling: Sequence[ForceCurve], share: float
) -> Tests:
    top = float(np.median([curve.axial.max() for curve in telling]))
    edges = np.linspace(_FIRST * top, top, BINS + 1)
    axial = np.linspace(0, top, NODES)
    loadings = tuple(_binned(curve, edges, axial) for curve in curves)
    known = [loading for loading, curve in zip(loadings, curves, strict=True) if any(curve is one for one in telling)]
    return Tests(fabric, direction, axial, loadings, _scatter(known, share))


def _binned(curve: ForceCurve, edges: np.ndarray, axial: np.ndarray) -> Loading:
    place = np.searchsorted(edges, curve.axial, side="right") - 1
    place[curve.axial == edges[-1]] = BINS - 1  # as in numpy.histogram the last bin has both its edges
    inside = (place >= 0) & (place < BINS)
    values = np.stack([curve.axial, curve.force, curve.transverse])
    means, average = np.full((3, BINS), np.nan), np.zeros((BINS, len(axial)))
    step = axial[1] - axial[0]
    for b in range(BINS):
        rows = np.flatnonzero(inside & (place == b))
        if not len(rows):
            continue
        known = rows[np.isfinite(curve.transverse[rows])]
        means[:2, b] = values[:2, rows].mean(1)
        means[2, b] = values[2, known].mean() if len(known) else np.nan
        at = np.clip(curve.axial[rows] / step, 0, len(axial) - 1 - 1e-9)
        node = at.astype(int)
        np.add.at(average[b], node, (1 - at + node) / len(rows))
        np.add.at(average[b], node + 1, (at - node) / len(rows))
    return Loading(curve, means[0], means[1], means[2], average)


def repeats_of(loadings: Sequence[Loading]) -> list[Loading]:
    """Loadings of used cloth, or all where that is fewer than two."""
    used = [loading for loading in loadings if loading.used]
    return used if len(used) > 1 else list(loadings)


def _spread(loadings: Sequence[Loading]) -> np.ndarray | None:
    """Variance between repeats (2, B), NaN where fewer than two were measured; None without repeats."""
    repeats = repeats_of(loadings)
    if len(repeats) < 2:
        return None
    stack = np.stack([loading.measured for loading in repeats])
    count = np.isfinite(stack).sum(0)
    left = stack - np.nansum(stack, 0) / np.maximum(count, 1)
    return np.where(count > 1, np.nansum(left**2, 0) / np.maximum(count - 1, 1), np.nan)


def _shares(groups: Iterable[Sequence[ForceCurve]]) -> list[float]:
    """:func:`_share` of those that have repeats."""
    return [share for group in groups if (share := _share(group)) is not None]


def _share(curves: Sequence[ForceCurve]) -> float | None:
    """Scatter of force between repeats over the force, rms; None without repeats."""
    top = min(float(curve.axial.max()) for curve in curves)
    edges, axial = np.linspace(_FIRST * top, top, BINS + 1), np.linspace(0, top, NODES)
    loadings = [_binned(curve, edges, axial) for curve in curves]
    spread = _spread(loadings)
    if spread is None:
        return None
    mean = np.nanmean([np.nanmean(loading.force**2) for loading in loadings])
    return float(np.sqrt(np.nanmean(spread[0]) / mean))


def _scatter(loadings: Sequence[Loading], share: float) -> np.ndarray:
    """Standard deviation between repeats (2, B), smoothed over strain; what other tests have where there are none."""
    force = np.stack([loading.force for loading in loadings])
    largest = float(np.nanmax(force))
    spread = _spread(loadings)
    if spread is None:
        spread = np.stack([(share * np.nan_to_num(force[0], nan=largest)) ** 2, np.full(BINS, np.nan)])
    floor = np.array([LEAST_FORCE * largest, LEAST_STRAIN])[:, None]
    return np.sqrt(np.stack([_smoothed(row) for row in spread]) + floor**2)


def _smoothed(variance: np.ndarray, reach: int = 2) -> np.ndarray:
    """Means over neighbouring bins (B,); of all bins where none is known nearby, 0 where none is known at all."""
    known = np.isfinite(variance)
    if not known.any():
        return np.zeros_like(variance)
    filled = np.where(known, variance, 0.0)
    kernel = np.ones(2 * reach + 1)
    count = np.convolve(known.astype(float), kernel, "same")
    sums = np.convolve(filled, kernel, "same")
    return np.where(count > 0, sums / np.maximum(count, 1), variance[known].mean())
