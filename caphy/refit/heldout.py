"""The error on measurements that nothing was fitted to, before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.effects.model import Model
from caphy.measure.noise import measurement_noise
from caphy.measure.scene import Scene
from caphy.refit.columns import Column
from caphy.refit.evidence import evidence, robust_weights
from caphy.refit.responses import Response
from caphy.refit.study import SNAPPED, Progress, Study


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Median distances of vertices from their measured places [mm], over all windows, frames and vertices.

    Attributes:
        before_mm, after_mm: of the model as it was, and as it is.
        floor_mm: what the noise of the measurement alone gives; none if it is not known.
        before, after: median of each window (W,) [mm].
        share: of the misfit that is gone, the windows' starts free as in a fit: finer than medians, which noise
            dominates.
    """

    before_mm: float
    after_mm: float
    floor_mm: float | None
    before: np.ndarray
    after: np.ndarray
    share: float


def held_out_errors(
    scenes: Sequence[Scene],
    before: Model,
    after: Model,
    variance: np.ndarray,
    progress: Progress | None = None,
    columns: Sequence[Column] = (),
    known: Mapping[str, float] | None = None,
) -> HeldOut:
    """Roll out both models on held-out scenes.

    ``columns`` and ``known`` are what base measurements taught to expect, as in :meth:`Study.correct`.
    """
    study = Study(scenes, progress=progress)
    old = study.correct(study.respond(before, columns, "held-out windows"), columns, known or {})
    new = study.respond(after, (), "held-out windows")
    noise = [measurement_noise(scene.measurement) for scene in scenes]
    stated = [1e3 * found.median for found in noise if found is not None]
    return judged(old, new, variance, float(np.median(stated)) if stated else None)


def judged(
    old: Sequence[Response], new: Sequence[Response], variance: np.ndarray, floor_mm: float | None = None
) -> HeldOut:
    """Windows before and after; one that gets much worse counts no more than twice what it did (a fold that snaps)."""
    first = evidence([replace(r, columns=r.columns[..., :0]) for r in old], variance)
    first = replace(first, weight=robust_weights(first))
    was = first.weight * first.c
    now = np.minimum(first.weight * evidence(new, variance).c, SNAPPED * was)
    errors = [[1e3 * response.error for response in each] for each in (old, new)]
    medians = [np.array([np.nanmedian(window) for window in each]) for each in errors]
    pooled = [float(np.nanmedian(np.concatenate([window.ravel() for window in each]))) for each in errors]
    gone = 1 - float(now.sum() / was.sum())
    return HeldOut(pooled[0], pooled[1], floor_mm, medians[0], medians[1], gone)
