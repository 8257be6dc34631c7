"""What chance gives an explanation that acts in few windows.

Signs of windows (:func:`caphy.diagnose.screen.null_gains`) are drawn alike once in 2^m times where m windows decide,
and then give the very gain that was seen. What acts in so few windows must fit what is left in *them* better than what
is left elsewhere: replicas put other windows' residuals in each window's place, the scene turned about the vertical or
mirrored, as large as the window's own. A permutation test (Good, Permutation, Parametric, and Bootstrap Tests of
Hypotheses, 2005); that windows can be exchanged is the null.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caphy.diagnose.screen import FLIPS, gains
from caphy.refit.evidence import Evidence, marginalised, whitened
from caphy.refit.responses import Response

FEW = 6.0
"""Windows: in fewer signs are drawn alike more often than once in 2^6 times, and there may be several such effects."""


def deciding(known: Evidence) -> float:
    """How many windows decide on the numbers: 1 / sum h^2 of their shares h in the curvature; 0 where none does.

    An effective number of clusters, as in Carter, Schnepel, Steigerwald, REStat 99, 2017.
    """
    normal, _ = known.normal
    share = known.weight * np.einsum("wkl,lk->w", known.a, np.linalg.pinv(normal, hermitian=True))
    return float(share.sum() ** 2 / (share**2).sum()) if share.any() else 0.0


def in_few(known: Evidence, places: dict[str, list[int]]) -> list[str]:
    """Labels of the explanations that act in few windows and leave as many or more alone: there must be an elsewhere.

    Args:
        places: the columns of all explanations, by label.
    """
    most = min(FEW, len(known.c) / 2)
    return [label for label, index in places.items() if deciding(known.picked(index)) < most]


def borrowed_gains(
    known: Evidence,
    responses: Sequence[Response],
    variance: np.ndarray,
    places: Sequence[Sequence[int]],
    limits: tuple[np.ndarray, np.ndarray],
    seed: int = 0,
) -> np.ndarray:
    """The best gain (R,) of some explanations in replicas where windows have others' residuals.

    Args:
        known: windows (W of them) in the columns of the whole library.
        responses: the same windows as they are.
        variance: of each mode at each lag (L, M) [m^2].
        places: the columns of each explanation.
        limits: lower and upper bounds of all columns.
    """
    best = np.full(FLIPS, -np.inf)
    if len(responses) < 2 or not places:
        return best
    columns = sorted({place for some in places for place in some})
    b = _borrowed(known, responses, variance, columns, np.random.default_rng(seed))
    for some in places:
        index = list(some)
        own = b[..., [columns.index(place) for place in index]]
        best = np.maximum(best, gains(known.picked(index), own, limits[0][index], limits[1][index]))
    return best


def _borrowed(
    known: Evidence,
    responses: Sequence[Response],
    variance: np.ndarray,
    columns: Sequence[int],
    random: np.random.Generator,
) -> np.ndarray:
    """b (R, W, K) of windows with other windows' residuals, each of the chi2 of the window that it is put in."""
    left = [_everywhere(response, variance) for response in responses]
    turns, many = _turns(random), len(responses)
    b = np.zeros((FLIPS, many, len(columns)))
    for here, response in enumerate(responses):
        others = random.integers(0, many - 1, FLIPS)
        lent = np.stack([left[other + (other >= here)] @ turn.T for other, turn in zip(others, turns, strict=True)])
        _, s, n = whitened(response, variance)
        _, own, chi2 = marginalised(lent[:, response.seen].reshape(FLIPS, -1).T, s[:, columns], n)
        b[:, here] = (own * np.sqrt(known.c[here] / np.maximum(chi2, 1e-300))).T
    return b


def _everywhere(response: Response, variance: np.ndarray) -> np.ndarray:
    """The residual (L, M, 3) by its standard deviation; zero where nothing was seen."""
    return np.where(response.seen[:, None, None], response.residual, 0.0) / np.sqrt(variance)[:, :, None]


def _turns(random: np.random.Generator) -> np.ndarray:
    """Rotations about the vertical, half of them mirrored (R, 3, 3)."""
    angle, mirror = random.uniform(0, 2 * np.pi, FLIPS), random.choice([-1.0, 1.0], FLIPS)
    turns = np.zeros((FLIPS, 3, 3))
    turns[:, 0, 0], turns[:, 0, 2] = np.cos(angle), np.sin(angle) * mirror
    turns[:, 2, 0], turns[:, 2, 2] = -np.sin(angle), np.cos(angle) * mirror
    turns[:, 1, 1] = 1
    return turns
