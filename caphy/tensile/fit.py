"""Fitting a model's numbers to the tensile tests of one fabric; how well loadings left out are foretold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from caphy.effects.model import Model
from caphy.kept import Kept
from caphy.tensile.candidates import HISTORY
from caphy.tensile.loadings import Tests
from caphy.tensile.numbers import Number, changed
from caphy.tensile.strip import Strip

_ITERATIONS = 40
_GAIN = 1e-4  # share of the misfit below which an iteration ends the fit
_RIDGE = 1e-9


Curves = dict[tuple[str, bool], np.ndarray]
"""Force [N/m] and transverse strain (2, N), by direction and whether the cloth is used."""


@dataclass(frozen=True, eq=False)
class Bench:
    """The tests of one fabric with the strips that pull its models.

    Attributes:
        model: the user's model.
        acting: names of effects that act in tensile tests.
        held: numbers that are known from elsewhere, with their values.
        kept: where fits are kept until all is done.
    """

    model: Model
    tests: list[Tests]
    acting: frozenset[str]
    strips: dict[str, Strip]
    held: tuple[tuple[Number, float], ...] = ()
    kept: Kept = field(default_factory=Kept)

    @classmethod
    def of(cls, model: Model, tests: list[Tests], acting: frozenset[str], kept: Kept) -> Bench:
        strips = {test.direction: Strip(test.axial, test.direction) for test in tests}
        return cls(model, tests, acting, strips, kept=kept)

    @property
    def count(self) -> int:
        return sum(len(test.loadings) for test in self.tests)

    def with_tests(self, tests: list[Tests]) -> Bench:
        """The same strips, other loadings; of a direction that was not learned from too."""
        strips = {test.direction: Strip(test.axial, test.direction) for test in tests} | self.strips
        return replace(self, tests=tests, strips=strips)

    def models(self, numbers: Sequence[Number], values: np.ndarray) -> tuple[Model, Model]:
        """The model of the first loading and that of used cloth."""
        numbers = (*numbers, *(number for number, _ in self.held))
        values = np.array([*values, *(value for _, value in self.held)])
        return changed(self.model, numbers, values, False), changed(self.model, numbers, values, True)

    def curves(self, numbers: Sequence[Number], values: np.ndarray) -> Curves:
        """What the model says with these numbers."""
        return self.curves_of(*self.models(numbers, values))

    def curves_of(self, first: Model, used: Model) -> Curves:
        """What models of the first loading and of used cloth say."""
        found: Curves = {}
        for again, model in enumerate((first, used)):
            names = tuple(name for name in model.effects if name in self.acting)
            for test in self.tests:
                if any(loading.used == bool(again) for loading in test.loadings):
                    said = self.strips[test.direction].curve(remembering(model, test.reached), names)
                    found[test.direction, bool(again)] = np.stack([said.force, said.transverse])
        return found

    def residual(self, curves: Curves) -> np.ndarray:
        """Measured less said, over the scatter of repeats (loadings, 2, B); 0 where nothing was measured."""
        rows = [
            (loading.measured - curves[test.direction, loading.used] @ loading.average.T) / test.scatter
            for test in self.tests
            for loading in test.loadings
        ]
        return np.nan_to_num(np.stack(rows))

    def slopes(self, numbers: Sequence[Number], values: np.ndarray) -> np.ndarray:
        """Derivative of minus the residual by each number (loadings, 2, B, K), by differences within the bounds."""
        here = self.residual(self.curves(numbers, values))
        columns = []
        for k, number in enumerate(numbers):
            step = _step(number, float(values[k]))
            moved = np.array(values, float)
            moved[k] += step
            columns.append((here - self.residual(self.curves(numbers, moved))) / step)
        return np.stack(columns, -1) if columns else np.zeros((*here.shape, 0))


def remembering(model: Model, reached: float) -> Model:
    """The model of cloth that had an energy per area [N/m] before."""
    for name in set(HISTORY) & set(model.effects):
        model = model.with_effect(name, **{HISTORY[name]: reached})
    return model


def _step(number: Number, value: float) -> float:
    scale = max(abs(value), 1e-2 * abs(float(np.max(np.abs(number.declared.default)))), 1e-6)
    step = 1e-4 * (1.0 if number.relative else scale)
    return -step if value + step > number.bounds[1] else step


@dataclass(frozen=True, eq=False)
class Fit:
    """Numbers that meet the tests of one fabric best.

    Attributes:
        values: (K,).
        residual: over the scatter of repeats (L, 2, B).
        slopes: of the model by each number, over the scatter (L, 2, B, K).
    """

    bench: Bench
    numbers: tuple[Number, ...]
    values: np.ndarray
    residual: np.ndarray
    slopes: np.ndarray

    @property
    def misfit(self) -> float:
        return float((self.residual**2).sum())

    @property
    def models(self) -> tuple[Model, Model]:
        """The model of the first loading and that of used cloth."""
        return self.bench.models(self.numbers, self.values)

    @property
    def left_out(self) -> np.ndarray:
        """Residual of each loading when the fit did without it (L, 2, B), to first order."""
        count, k = len(self.residual), len(self.numbers)
        if not k:
            return self.residual
        slopes, residual = self.slopes.reshape(count, -1, k), self.residual.reshape(count, -1)
        normal = np.einsum("lik,lim->lkm", slopes, slopes)
        whole, rows = normal.sum(0), []
        for one in range(count):
            without = whole - normal[one]
            change = _solved(without, slopes[one].T @ residual[one], np.diag(whole))
            rows.append(residual[one] + slopes[one] @ change)
        return np.stack(rows).reshape(self.residual.shape)

    @property
    def foretold(self) -> float:
        """Sum of squares of :attr:`left_out`."""
        return float((self.left_out**2).sum())


def _solved(normal: np.ndarray, right: np.ndarray, scale: np.ndarray) -> np.ndarray:
    scale = np.sqrt(np.maximum(scale, 1e-300))
    scaled = normal / scale[:, None] / scale[None]
    return np.linalg.lstsq(scaled + _RIDGE * np.eye(len(scale)), right / scale, rcond=1e-10)[0] / scale


def fitted(bench: Bench, numbers: Sequence[Number], start: np.ndarray | None = None) -> Fit:
    """Least squares over all loadings by Levenberg and Marquardt's method, within the bounds of the numbers."""
    numbers = tuple(numbers)
    values = np.array([n.start(bench.model) for n in numbers]) if start is None else np.array(start, float)
    key = bench.kept.key("fit", bench.model, bench.tests, bench.acting, bench.held, numbers, values)
    if (known := bench.kept.recall(key)) is not None:
        return Fit(bench, numbers, **known)
    bounds = np.array([number.bounds for number in numbers]).reshape(-1, 2)
    residual, damping = bench.residual(bench.curves(numbers, values)), 1e-3
    slopes = bench.slopes(numbers, values)
    for _ in range(_ITERATIONS if numbers else 0):
        matrix, right = slopes.reshape(-1, len(numbers)), residual.reshape(-1)
        normal, slope = matrix.T @ matrix, matrix.T @ right
        free = ~(((values <= bounds[:, 0]) & (slope < 0)) | ((values >= bounds[:, 1]) & (slope > 0)))
        old = (residual**2).sum()
        for _ in range(12):
            change = np.zeros(len(values))
            inner = normal[np.ix_(free, free)]
            change[free] = _solved(inner + damping * np.diag(np.diag(inner)), slope[free], np.diag(inner))
            tried = np.clip(values + change, bounds[:, 0], bounds[:, 1])
            found = bench.residual(bench.curves(numbers, tried))
            if (found**2).sum() < old:
                break
            damping *= 4
        else:
            break
        values, residual, damping = tried, found, max(damping / 10, 1e-9)
        slopes = bench.slopes(numbers, values)
        if old - (residual**2).sum() < _GAIN * old:
            break
    bench.kept.keep(key, {"values": values, "residual": residual, "slopes": slopes})
    return Fit(bench, numbers, values, residual, slopes)
