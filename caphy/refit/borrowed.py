"""What chance gives a number that few windows decide on.

Signs of windows (:func:`caphy.diagnose.screen.null_gains`) are drawn alike once in 2^m times where m windows decide,
and then give the very gain that was seen; a standard error over windows is as large as their sum where one decides.
What acts in so few windows must fit what is left in *them* better than what is left elsewhere: replicas put other
windows' residuals in each window's place, the scene turned about the vertical or mirrored, as large as the window's
own. A permutation test (Good, Permutation, Parametric, and Bootstrap Tests of Hypotheses, 2005); that windows can be
exchanged is the null.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caphy.refit.evidence import Evidence, marginalised, whitened
from caphy.refit.responses import Response

FEW = 6.0
"""Windows: in fewer signs are drawn alike more often than once in 2^6 times, and there may be several such effects."""
REPLICAS = 200
"""How often residuals are borrowed."""
CHANCE = 0.95
"""Of the replicas: how many must take away less than a change does that is believed."""


def deciding(share: np.ndarray) -> float:
    """How many windows decide, by each one's share (W,) in the curvature: (sum s)^2 / sum s^2; 0 where none does.

    An effective number of clusters, as in Carter, Schnepel, Steigerwald, REStat 99, 2017.
    """
    return float(share.sum() ** 2 / (share**2).sum()) if share.any() else 0.0


def few(share: np.ndarray) -> bool:
    """Whether few windows decide, and as many or more do not: there must be an elsewhere to borrow from."""
    return len(share) > 1 and deciding(share) < min(FEW, len(share) / 2)


def borrowed(
    known: Evidence, responses: Sequence[Response], variance: np.ndarray, columns: Sequence[int], seed: int = 0
) -> np.ndarray:
    """b (R, W, K) of two windows or more with other windows' residuals, each of the chi2 of the one that it is put in.

    Args:
        known: what the windows say.
        responses: the same windows.
        variance: of each mode at each lag (L, M) [m^2].
        columns: K of the responses' columns.
    """
    left = [_everywhere(response, variance) for response in responses]
    random, many = np.random.default_rng(seed), len(responses)
    turns = _turns(random)
    b = np.zeros((REPLICAS, many, len(columns)))
    for here, response in enumerate(responses):
        others = random.integers(0, many - 1, REPLICAS)
        lent = np.stack([left[other + (other >= here)] @ turn.T for other, turn in zip(others, turns, strict=True)])
        _, s, n = whitened(response, variance)
        _, own, chi2 = marginalised(lent[:, response.seen].reshape(REPLICAS, -1).T, s[:, columns], n)
        b[:, here] = (own * np.sqrt(known.c[here] / np.maximum(chi2, 1e-300))).T
    return b


@dataclass(frozen=True)
class Few:
    """What a change of numbers, fitted elsewhere, takes away where few windows decide; shares of the misfit.

    Attributes:
        chance: with borrowed residuals, at most.
        promise: if the numbers are right: by the curvature, as e = S d falls by d.A d.
    """

    chance: float
    promise: float


def where_few_decide(
    known: Evidence, responses: Sequence[Response], variance: np.ndarray, change: np.ndarray
) -> Few | None:
    """For a change (K,); none where many windows decide. ``responses`` have its columns, and are otherwise as in
    :func:`borrowed`."""
    bent = known.weight * np.einsum("k,wkl,l->w", change, known.a, change)
    if not few(bent):
        return None
    b = borrowed(known, responses, variance, range(len(change)))
    falls = 2 * np.einsum("w,rwk,k->r", known.weight, b, change) - bent.sum()
    total = float((known.weight * known.c).sum())
    return Few(float(np.quantile(falls, CHANCE)) / total, float(bent.sum()) / total)


def _everywhere(response: Response, variance: np.ndarray) -> np.ndarray:
    """The residual (L, M, 3) by its standard deviation; zero where nothing was seen."""
    return np.where(response.seen[:, None, None], response.residual, 0.0) / np.sqrt(variance)[:, :, None]


def _turns(random: np.random.Generator) -> np.ndarray:
    """Rotations about the vertical, half of them mirrored (R, 3, 3)."""
    angle, mirror = random.uniform(0, 2 * np.pi, REPLICAS), random.choice([-1.0, 1.0], REPLICAS)
    turns = np.zeros((REPLICAS, 3, 3))
    turns[:, 0, 0], turns[:, 0, 2] = np.cos(angle), np.sin(angle) * mirror
    turns[:, 2, 0], turns[:, 2, 2] = -np.sin(angle), np.cos(angle) * mirror
    turns[:, 1, 1] = 1
    return turns
