"""Windows of several measurements, and fits of a model's numbers to them by Gauss-Newton on real roll-outs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.measure.noise import measurement_noise
from caphy.measure.scene import Scene
from caphy.measure.windows import LENGTH
from caphy.refit.columns import Column, moved
from caphy.refit.evidence import Evidence, bounded, estimated_variance, evidence
from caphy.refit.responses import Response, watched

FEWEST = 4
"""Windows without which nothing can be told."""

_ROUNDS = 5
_SETTLED = 0.01  # of the misfit: what a further Gauss-Newton step must promise

Progress = Callable[[str, int, int], None]


class Study:
    """The windows of some measurements."""

    def __init__(self, scenes: Sequence[Scene], length: int = LENGTH, progress: Progress | None = None) -> None:
        """Raises :class:`CaphyError` where there are too few windows."""
        self.scenes, self.length, self.progress = tuple(scenes), length, progress
        self.watched = watched(scenes, length)
        self.starts = [each.starts() for each in self.watched]
        if sum(map(len, self.starts)) < FEWEST:
            names = ", ".join(scene.measurement.source or scene.measurement.name for scene in scenes)
            raise CaphyError(
                f"{names}: needs at least {FEWEST} windows of {length} frames, each with half of the vertices seen "
                f"around its start, got {sum(map(len, self.starts))}; measure longer motions"
            )

    @property
    def noise(self) -> float:
        """Standard deviation of a mode's coefficient by the noise of the measurements [m], the largest of them."""
        found = []
        for each in self.watched:
            noise = measurement_noise(each.scene.measurement)
            found.append(0.0 if noise is None else noise.sigma / np.sqrt(len(each.scene.garment.vertices)))
        return max(found)

    def respond(self, model: Model, columns: Sequence[Column], what: str = "rolling out") -> list[Response]:
        """All windows against a model."""
        total, responses = sum(map(len, self.starts)), []
        for each, starts in zip(self.watched, self.starts, strict=True):
            for response in each.respond(model, columns, starts):
                responses.append(response)
                if self.progress is not None:
                    self.progress(what, len(responses), total)
        return responses

    def variance(self, responses: Sequence[Response]) -> np.ndarray:
        """The variance (L, M) [m^2] that nothing explains."""
        return estimated_variance(responses, self.noise)


@dataclass(frozen=True, eq=False)
class Fit:
    """A model fitted to windows.

    Attributes:
        model: with the fitted numbers.
        columns: what was fitted.
        values: their values (K,); relative changes since the start where a column is one.
        evidence: at the fitted model, in the fitted columns.
        responses: the windows at the fitted model.
        misfit: weighted chi2 over all windows.
        converged: whether another step promised nothing.
    """

    model: Model
    columns: tuple[Column, ...]
    values: np.ndarray
    evidence: Evidence
    responses: list[Response]
    misfit: float
    converged: bool


def fit(
    study: Study,
    model: Model,
    columns: Sequence[Column],
    variance: np.ndarray,
    weight: np.ndarray,
    first: np.ndarray | None = None,
    what: str = "fitting",
) -> Fit:
    """Change numbers of a model so that its roll-outs meet the windows; ``first`` (K,) is a first change to try.

    Gauss-Newton with halved steps where a step makes things worse; bounds are kept.
    """
    columns = tuple(columns)
    total = np.zeros(len(columns))
    best = _tried(study, model, columns, total, variance, weight, what)
    step = _step(best, model, columns) if first is None else np.asarray(first, float)
    for _ in range(_ROUNDS):
        there = _tried(study, model, columns, best.values + step, variance, weight, what)
        if there.misfit < best.misfit:
            gained = best.misfit - there.misfit
            best = there
            step = _step(best, moved(model, columns, best.values), columns)
            promise = float(2 * step @ best.evidence.normal[1] - step @ best.evidence.normal[0] @ step)
            if max(promise, 0.1 * gained) < _SETTLED * best.misfit:
                return replace(best, converged=True)
        else:
            step = 0.4 * step
    return best


def _tried(study, model, columns, change, variance, weight, what) -> Fit:
    """The model with a change of its numbers, held against the windows."""
    there = moved(model, columns, change)
    relative = tuple(replace(column) for column in columns)
    responses = study.respond(there, relative, what)
    known = evidence(responses, variance, weight)
    # A proportional column at the new model is in units of its new value.
    scale = np.array(
        [1 / (1 + by) if column.entry is None else 1.0 for column, by in zip(columns, change, strict=True)]
    )
    known = Evidence(known.a * scale[:, None] * scale, known.b * scale, known.c, known.weight, known.count)
    misfit = float(known.misfit(np.zeros(len(columns))).sum())
    return Fit(there, columns, np.asarray(change, float), known, responses, misfit, False)


def _step(at: Fit, model: Model, columns: Sequence[Column]) -> np.ndarray:
    normal, right = at.evidence.normal
    limits = np.array([c.bounds(model) if c.entry is not None else (-0.6, 2.0) for c in columns]).reshape(-1, 2)
    return bounded(normal, right, limits[:, 0], limits[:, 1])
