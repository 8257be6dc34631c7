"""The error on measurements that nothing was fitted to, before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caphy.effects.model import Model
from caphy.measure.noise import measurement_noise
from caphy.measure.scene import Scene
from caphy.refit.study import Progress, Study


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Median distances of vertices from their measured places [mm], over all windows, frames and vertices.

    Attributes:
        before_mm, after_mm: of the model as it was, and as it is.
        floor_mm: what the noise of the measurement alone gives; none if it is not known.
        before, after: median of each window (W,) [mm].
    """

    before_mm: float
    after_mm: float
    floor_mm: float | None
    before: np.ndarray
    after: np.ndarray


def held_out_errors(
    scenes: Sequence[Scene], before: Model, after: Model, variance: np.ndarray, progress: Progress | None = None
) -> HeldOut:
    """Roll out both models on held-out scenes; starts are found by each model for itself, alike."""
    study = Study(scenes, progress=progress)
    old = window_errors(study, before, variance)
    new = old if after is before else window_errors(study, after, variance)
    noise = [measurement_noise(scene.measurement) for scene in scenes]
    known = [1e3 * found.median for found in noise if found is not None]
    medians = [np.array([np.nanmedian(window) for window in errors]) for errors in (old, new)]
    pooled = [float(np.nanmedian(np.concatenate([window.ravel() for window in errors]))) for errors in (old, new)]
    return HeldOut(pooled[0], pooled[1], float(np.median(known)) if known else None, medians[0], medians[1])


def window_errors(study: Study, model: Model, variance: np.ndarray) -> list[np.ndarray]:
    """Distances (L, V) [mm] in each window."""
    responses = study.respond(model, None, study.settled(model, variance), "held-out windows")
    return [1e3 * response.error for response in responses]
