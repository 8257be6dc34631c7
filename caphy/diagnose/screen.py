"""The screen: how much of the misfit each explanation takes away in windows that it was not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caphy.diagnose.groups import Group
from caphy.effects.model import Model
from caphy.refit.borrowed import REPLICAS, borrowed, few
from caphy.refit.columns import Column
from caphy.refit.evidence import Evidence, bounded, inverse
from caphy.refit.responses import Response

FLIPS = 200
"""Replicas of the null."""


@dataclass(frozen=True)
class Score:
    """One explanation in the screen.

    Attributes:
        group: which.
        gain: share of the misfit that is gone in windows left out of the fit.
        wald: square of the estimate over its error, clustered by window; 0 at a bound.
        change: the linear estimate of its numbers (K,).
    """

    group: Group
    gain: float
    wald: float
    change: np.ndarray

    @property
    def size(self) -> int:
        return len(self.change)


def bounds(columns: Sequence[Column], model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limits of changes (K,) each."""
    limits = np.array([column.bounds(model) for column in columns]).reshape(-1, 2)
    return limits[:, 0], limits[:, 1]


def screened(known: Evidence, groups: Sequence[Group], places: dict[str, list[int]], model: Model) -> list[Score]:
    """Scores of groups, best first; ``known`` are windows at the model, in the columns of all groups."""
    columns = [column for group in groups for column in group.columns]
    lower, upper = bounds(columns, model)
    null = float(known.misfit(np.zeros(known.b.shape[1])).sum())
    scores = []
    for group in groups:
        index = places[group.label]
        picked = known.picked(index)
        gain = 1 - float(_left_out(picked, lower[index], upper[index]).sum()) / null
        change = bounded(*picked.normal, lower[index], upper[index])
        scores.append(Score(group, gain, _wald(picked, change), change))
    return sorted(scores, key=lambda score: -score.gain)


def _left_out(known: Evidence, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """chi2 of each window (W,) with numbers fitted to all the others."""
    return known.misfit(known.left_out(lambda normal, right: bounded(normal, right, lower, upper)))


def covariance(known: Evidence, change: np.ndarray) -> np.ndarray:
    """Covariance (K, K) of estimates, clustered by window (Liang, Zeger, Biometrika 73, 1986), as a jackknife's."""
    normal, _ = known.normal
    ridge = 1e-9 * np.diag(np.diag(normal)) + 1e-300 * np.eye(len(normal))
    inverse = np.linalg.inv(normal + ridge)
    scores = known.weight[:, None] * (known.b - np.einsum("wkl,l->wk", known.a, change))
    many = len(scores)
    return inverse @ (scores.T @ scores) @ inverse * many / max(many - 1, 1)


def _wald(known: Evidence, change: np.ndarray) -> float:
    """Of changes (K,), each in units of its own error."""
    if not change.any():
        return 0.0
    spread = covariance(known, change)
    error = np.sqrt(np.diag(spread))
    error[error == 0] = 1.0  # of what does nothing, whose change is zero
    return float(change / error @ np.linalg.lstsq(spread / np.outer(error, error), change / error, rcond=1e-9)[0])


def null_gains(
    known: Evidence, places: Sequence[Sequence[int]], limits: tuple[np.ndarray, np.ndarray], seed: int = 0
) -> np.ndarray:
    """The best gain (R,) of some explanations in replicas where nothing is missing.

    Under the null a window's residual is as likely as its mirror image, whatever correlates within the window: signs
    of whole windows are drawn (Wu 1986; Cameron, Gelbach, Miller, REStat 90, 2008: the wild cluster bootstrap).

    Args:
        places: the columns of each explanation.
        limits: lower and upper bounds of all columns.
    """
    random = np.random.default_rng(seed)
    signs = random.choice([-1.0, 1.0], (FLIPS, len(known.c)))
    best = np.full(FLIPS, -np.inf)
    for some in places:
        index = list(some)
        picked = known.picked(index)
        best = np.maximum(best, gains(picked, signs[:, :, None] * picked.b, limits[0][index], limits[1][index]))
    return best


def in_few(known: Evidence, places: dict[str, list[int]]) -> list[str]:
    """Labels of the explanations on which few windows decide; ``places`` are the columns of all."""
    return [label for label, index in places.items() if few(_shares(known.picked(index)))]


def _shares(known: Evidence) -> np.ndarray:
    """What each window (W,) adds to the curvature, all columns counted alike."""
    return known.weight * np.einsum("wkl,lk->w", known.a, inverse(known.normal[0]))


def borrowed_gains(
    known: Evidence,
    responses: Sequence[Response],
    variance: np.ndarray,
    places: Sequence[Sequence[int]],
    limits: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """The best gain (R,) of some explanations where windows have other windows' residuals; :func:`null_gains` for what
    few windows decide on. ``variance`` is of each mode at each lag (L, M) [m^2]."""
    best = np.full(REPLICAS, -np.inf)
    columns = sorted({place for some in places for place in some})
    if len(responses) < 2 or not columns:
        return best
    b = borrowed(known, responses, variance, columns)
    for some in places:
        index = list(some)
        own = b[..., [columns.index(place) for place in index]]
        best = np.maximum(best, gains(known.picked(index), own, limits[0][index], limits[1][index]))
    return best


def gains(known: Evidence, b: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Share (R,) of the misfit that is gone in windows left out in turn, in replicas of b (R, W, K)."""
    weighted, a = known.weight, known.a
    normal = np.einsum("w,wkl->kl", weighted, a) - weighted[:, None, None] * a  # without each window
    right = np.einsum("w,rwk->rk", weighted, b)[:, None] - weighted[:, None] * b
    size = np.arange(a.shape[1])
    normal[:, size, size] *= 1 + 1e-9
    normal[:, size, size] += 1e-300
    fits = np.clip(np.linalg.solve(normal[None], right[..., None])[..., 0], lower, upper)
    bent = np.einsum("rwk,wkl,rwl->rw", fits, a, fits)
    left = (weighted * (known.c - 2 * (fits * b).sum(-1) + bent)).sum(-1)
    return 1 - left / (weighted * known.c).sum()
