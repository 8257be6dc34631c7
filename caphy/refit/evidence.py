"""What windows say about numbers of a model, condensed to one small quadratic form per window.

With a residual e, responses S and nuisances N (in units of their standard deviations) a window's misfit is

    chi2(a) = min_z (e - S a - N z)^T D^-1 (e - S a - N z) + z^T z = c - 2 a.b + a.A a,

where D is the variance that each mode has at each lag: noise, and what the solver and its mesh miss. Leaving windows
out, fitting subsets of columns and resampling then cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.errors import CaphyError
from caphy.refit.responses import Response

KINDS = (
    "registered measurements and point clouds must not be mixed, base and held-out ones included: what noise does is "
    "learned from some and expected in others; give clouds alone, or registered vertices alone"
)
"""What is said where they are."""

_NOTHING = 1e-20  # curvature of a number that does nothing, in whatever unit: what is left is rounding
_ROUNDS = 4
_LEAST = (2e-5) ** 2  # of a mode's variance [m^2]: far below what any scanner resolves
_WILD = 4.0  # times what a window's curvature becomes where all grow alike: what it may be


@dataclass(frozen=True, eq=False)
class Evidence:
    """Quadratic forms of W windows in K columns.

    Attributes:
        a (W, K, K), b (W, K), c (W,): as in the module's docstring.
        weight: how much each window counts (W,): chaotic ones less.
        count: entries that were compared in each window (W,).
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    weight: np.ndarray
    count: np.ndarray

    def picked(self, columns: Sequence[int]) -> Evidence:
        """The same windows with some of the columns."""
        index = np.asarray(columns, dtype=int)
        return Evidence(self.a[:, index[:, None], index], self.b[:, index], self.c, self.weight, self.count)

    def misfit(self, change: np.ndarray) -> np.ndarray:
        """chi2 of each window (W,), weighted, for changes (K,) or one per window (W, K)."""
        change = np.broadcast_to(change, self.b.shape)
        bent = np.einsum("wk,wkl,wl->w", change, self.a, change)
        return self.weight * (self.c - 2 * np.einsum("wk,wk->w", change, self.b) + bent)

    def along(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and second derivative of each window's weighted chi2 (W,) on the way along changes (K,), at zero."""
        slope = -2 * self.weight * np.einsum("wk,k->w", self.b, change)
        return slope, 2 * self.weight * np.einsum("k,wkl,l->w", change, self.a, change)

    @property
    def normal(self) -> tuple[np.ndarray, np.ndarray]:
        """Sum over windows of A (K, K) and b (K,), weighted."""
        return np.einsum("w,wkl->kl", self.weight, self.a), np.einsum("w,wk->k", self.weight, self.b)

    def left_out(self, solve: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """Changes (W, K) that all windows but each ask for, solved for from :attr:`normal` of these."""
        normal, right = self.normal
        told = zip(self.weight, self.a, self.b, strict=True)
        return np.array([solve(normal - w * a, right - w * b) for w, a, b in told]).reshape(self.b.shape)


@dataclass(frozen=True, eq=False)
class Weighing:
    """What windows are weighed by.

    Attributes:
        variance: of each mode at each lag (L, M) [m^2].
        weight: how much each window counts (W,).
    """

    variance: np.ndarray
    weight: np.ndarray

    @classmethod
    def robust(cls, responses: Sequence[Response], variance: np.ndarray) -> Weighing:
        """By which windows count less of which all columns together leave much."""
        return cls(variance, robust_weights(evidence(responses, variance)))

    def of(self, responses: Sequence[Response]) -> Evidence:
        """What these windows say, weighed so."""
        return evidence(responses, self.variance, self.weight)


def evidence(responses: Sequence[Response], variance: np.ndarray, weight: np.ndarray | None = None) -> Evidence:
    """The quadratic forms of windows, given the variance (L, M) [m^2] of each mode at each lag."""
    forms = [_form(response, variance) for response in responses]
    a, b, c, count = (np.stack([form[i] for form in forms]) for i in range(4))
    return Evidence(a, b, c, np.ones(len(forms)) if weight is None else weight, count)


def _form(response: Response, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    e, s, n = whitened(response, variance)
    a, b, c = marginalised(e[:, None], s, n)
    return a, b[:, 0], c[0], np.array(len(e))


def whitened(response: Response, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residual (n,), columns (n, K) and nuisances (n, N) in the frames that were seen, by the standard deviation.

    Raises :class:`CaphyError` where variances are of measurements of the other kind.
    """
    if variance.shape[1] != response.residual.shape[1]:
        raise CaphyError(KINDS)
    scale = 1 / np.sqrt(variance[response.seen])[:, :, None]
    e = (response.residual[response.seen] * scale).reshape(-1)
    s, n = (
        (x[response.seen] * scale[..., None]).reshape(len(e), x.shape[-1])
        for x in (response.columns, response.nuisance)
    )
    return e, s, n


def marginalised(e: np.ndarray, s: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (K, K), b (K, R) and c (R,) of R residuals (n, R) where nuisances (n, N) are free within their priors."""
    gram = np.linalg.cholesky(np.eye(n.shape[1]) + n.T @ n)
    ne, ns = (np.linalg.solve(gram, n.T @ x) for x in (e, s))
    return s.T @ s - ns.T @ ns, s.T @ e - ns.T @ ne, (e**2).sum(0) - (ne**2).sum(0)


def estimated_variance(responses: Sequence[Response], noise: float, ridge: float = 1e-3) -> np.ndarray:
    """The variance (L, M) [m^2] of each mode at each lag that no column and no nuisance explains.

    A few rounds of estimating what is left of the residuals with all columns fitted at once, then its variance; the
    same for all windows and axes, and a product of one factor per lag and one per mode, so that some dozens of windows
    are enough.

    Args:
        noise: standard deviation of a mode's coefficient by the noise of the measurement alone [m].
    """
    lags, modes = responses[0].residual.shape[:2]
    left = np.stack([r.residual for r in responses])
    variance = np.full((lags, modes), max(float(np.median(left**2)), noise**2, _LEAST))
    for _ in range(_ROUNDS):
        left = _left(responses, variance, ridge)
        variance = np.maximum(_separable(left), max(noise**2, _LEAST))
    return variance


def tamed(known: Evidence, first: Evidence) -> Evidence:
    """Windows in which tangents have not exploded since the ``first`` look, in the same columns.

    Where a fold is about to snap a number's smallest change moves everything, and one window's tangents can outweigh
    all the others' (139.7 of 143 of a shear stiffness' curvature) though they reach nowhere: the fit would stay where
    they are. What they say (A and b) counts no more than if the window's curvature had grown four times as much as
    windows' usually did; what the window misses (c) counts as before.
    """
    before = first.weight[:, None] * np.einsum("wkk->wk", first.a)
    after = known.weight[:, None] * np.einsum("wkk->wk", known.a)
    # A window that a number did not move before has no weight in what is usual.
    ratio = np.divide(after, before, out=np.ones_like(after), where=before > 0)
    usual = [_middle(grown, then) for grown, then in zip(ratio.T, before.T, strict=True)]
    most = np.where(before.any(axis=0), _WILD * np.array(usual) * np.maximum(before, before.mean(axis=0)), np.inf)
    trust = np.minimum(1, most / np.maximum(after, 1e-300)).min(axis=1, initial=1.0)
    return replace(known, a=known.a * trust[:, None, None], b=known.b * trust[:, None])


def borne_out(known: Evidence, first: Evidence, change: np.ndarray, last: np.ndarray) -> Evidence:
    """Curvatures that are no greater than slopes at either end of a change (K,) bear out.

    Where cloth wrinkles or is about to, tangents explode in many windows at once, while the misfit goes on falling as
    before: curvatures there say that the fit has arrived, and slopes that it has not. On the way between both ends
    slopes fall by what curvature there really is. If that is less than half of what the curvatures at the ends say in
    the mean, those that have grown since the ``first`` look are what they were there.

    Args:
        last: the same change as it is counted at its end (:func:`caphy.refit.columns.from_the_end`).
    """
    (a, b), (end_a, end_b) = first.normal, known.normal
    if change @ b - last @ end_b >= (change @ a @ change + last @ end_a @ last) / 4:
        return known
    unit = np.divide(change, last, out=np.ones_like(change), where=last != 0)
    was, now = unit**2 * np.diag(a), np.diag(end_a)
    kept = np.sqrt(np.divide(was, now, out=np.ones_like(was), where=(was > 0) & (was < now)))
    return replace(known, a=known.a * kept[:, None] * kept)


def _middle(ratio: np.ndarray, weight: np.ndarray) -> float:
    """The median of ratios (W,), each of which counts as much as its weight."""
    order = np.argsort(ratio)
    below = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(below, below[-1] / 2)])


def _left(responses: Sequence[Response], variance: np.ndarray, ridge: float) -> np.ndarray:
    """Squares (W, L, M) of what is left with everything fitted, corrected for the freedom of the fit; NaN unseen, as
    loops are of which nothing is known: their residual is zero."""
    known = evidence(responses, variance)
    known = replace(known, weight=robust_weights(known, ridge))
    change = ridged(*known.normal, ridge)
    squares = []
    for response in responses:
        e, n = _whitened(response, variance, change)
        solved = np.linalg.solve(np.eye(n.shape[1]) + n.T @ n, n.T)
        free = np.clip(1 - np.einsum("ij,ji->i", n, solved), 0.05, 1)
        square = ((e - n @ (solved @ e)) ** 2 / free).reshape(response.residual.shape).mean(-1) * variance
        squares.append(np.where(response.seen[:, None] & response.residual.any(axis=-1), square, np.nan))
    return np.stack(squares)


def _whitened(response: Response, variance: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a change of the columns leaves (n,) before the start moves, and the nuisances (n, N); zero unseen."""
    scale = response.seen[:, None, None] / np.sqrt(variance)[:, :, None]
    nuisance = (response.nuisance * scale[..., None]).reshape(-1, response.nuisance.shape[-1])
    residual = ((response.residual - response.columns @ change) * scale).reshape(-1)
    return residual, nuisance


def _separable(square: np.ndarray) -> np.ndarray:
    """Medians over windows of squares (W, L, M) as a product of a factor per lag and one per mode, (L, M)."""
    known, middle = np.isfinite(square).any(axis=0), np.zeros(square.shape[1:])
    if not known.any():
        return middle
    usual = np.nanmedian(square[:, known], axis=0) / 0.79  # the median of chi-square with 3 degrees over its mean
    middle[known] = np.log(np.maximum(usual, 1e-300))
    middle[~known] = middle[known].mean()
    grand = middle.mean()
    return np.exp(middle.mean(1, keepdims=True) + middle.mean(0, keepdims=True) - grand)


def robust_weights(known: Evidence, ridge: float = 1e-3) -> np.ndarray:
    """min(1, median / chi2) of what all columns together leave in each window (W,)."""
    even = replace(known, weight=np.ones(len(known.c)))
    per = np.maximum(even.misfit(ridged(*even.normal, ridge)) / known.count, 1e-12)
    return np.minimum(1, np.median(per) / per)


def ridged(normal: np.ndarray, right: np.ndarray, ridge: float) -> np.ndarray:
    """Solution (K,) of (A + ridge diag A) x = b, zero for numbers that do nothing.

    Each is solved for in a unit of its own: a bending's viscosity in N m s has 1e12 times the curvature of a stiffness
    in N/m, which beside it would look like nothing.
    """
    diagonal = np.diag(normal)
    used = diagonal > _NOTHING
    solution, unit = np.zeros_like(right), np.sqrt(diagonal[used])
    inner = normal[np.ix_(used, used)] / np.outer(unit, unit)
    solution[used] = np.linalg.solve(inner + ridge * np.eye(len(unit)), right[used] / unit) / unit
    return solution


def inverse(normal: np.ndarray) -> np.ndarray:
    """Inverse (K, K) of a curvature, zero for numbers that do nothing; each is solved for in a unit of its own, as by
    :func:`ridged`."""
    diagonal = np.diag(normal)
    per_unit = np.divide(1.0, np.sqrt(np.abs(diagonal)), out=np.zeros_like(diagonal), where=diagonal > _NOTHING)
    scale = np.outer(per_unit, per_unit)
    return np.linalg.pinv(normal * scale, hermitian=True) * scale


def bounded(normal: np.ndarray, right: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The minimiser (K,) of x.A x - 2 b.x within bounds, by clamping what strays and solving again.

    Exact for one coefficient and where clamped ones stay clamped, as in all groups of the library.
    """
    solution, free = np.zeros_like(right), np.ones(len(right), bool)
    for _ in range(len(right) + 1):
        if free.any():
            rest = right[free] - normal[np.ix_(free, ~free)] @ solution[~free]
            solution[free] = ridged(normal[np.ix_(free, free)], rest, 1e-9)
        clipped = np.clip(solution, lower, upper)
        if (clipped == solution).all():
            return solution
        free &= clipped == solution
        solution = clipped
    return solution
