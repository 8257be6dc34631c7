"""How sure fitted numbers are: windows resampled, not residuals, because what a window misses it misses throughout; and
what all windows miss alike, as far as base measurements tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from caphy.refit.borrowed import deciding, few
from caphy.refit.columns import Column, at_the_end, strengths
from caphy.refit.evidence import Evidence, inverse, ridged
from caphy.refit.fit import Fit
from caphy.refit.learned import Learned

REPLICAS = 500
LEVEL = 0.95
"""Of the intervals."""


def deviations(known: Evidence, seed: int = 0) -> np.ndarray:
    """Deviations (R, K) of the estimate where windows count more or less by chance.

    The Bayesian bootstrap (Rubin, Ann. Statist. 9, 1981): like drawing windows with replacement, but none is ever left
    out, so that a number which two windows decide is not told by those that know nothing of it.
    """
    random = np.random.default_rng(seed)
    many = len(known.c)
    best = ridged(*known.normal, 1e-9)
    found = []
    for _ in range(REPLICAS):
        drawn = known.weight * random.dirichlet(np.ones(many)) * many
        a, b = np.einsum("w,wkl->kl", drawn, known.a), drawn @ known.b
        found.append(ridged(a, b, 1e-6) - best)
    return np.array(found).reshape(REPLICAS, -1)


def _windows(known: Evidence) -> np.ndarray:
    """How many windows (K,) there are to tell each number, of those that decide where these are few."""
    inner = inverse(known.normal[0])
    shares = known.weight[:, None] * np.einsum("kl,wlm,mk->wk", inner, known.a, inner)
    count = [deciding(share) if few(share) else int((known.weight > 0.05).sum()) for share in shares.T]
    return np.maximum(np.array(count), known.b.shape[1] + 2)


def half_widths(known: Evidence, *doubts: np.ndarray | float, seed: int = 0) -> list[np.ndarray]:
    """Half widths (K,) of the :data:`LEVEL` intervals, for each of some ``doubts``.

    The spread of the bootstrap, widened by Student's t with as many degrees of freedom as there are windows left over:
    a dozen windows know their own spread only roughly, two hardly at all. Of n windows that bootstrap spreads a mean by
    (n - 1) / (n + 1) of its variance. Beside it a doubt (K,), a standard error that all windows share and no resampling
    of them can show.
    """
    spread, count = deviations(known, seed).std(axis=0), _windows(known)
    windows = student.ppf(0.5 + LEVEL / 2, count - known.b.shape[1]) * spread * np.sqrt((count + 1) / (count - 1))
    return [np.hypot(windows, norm.ppf(0.5 + LEVEL / 2) * doubt) for doubt in doubts]


def intervals(fit: Fit, learned: Learned | None, motions: int) -> dict[str, tuple[float, float, float, str]]:
    """Fitted numbers by name: value, lower and upper end of the :data:`LEVEL` interval, unit; that of a change in
    proportion is "relative".

    ``learned`` tells how far mesh and solver lead astray, ``motions`` how many the fit saw. The step that was left when
    the fit ended counts as an error too, on the side to which it points: effects of a few per cent of the misfit end a
    good part of it early. So does what telling the mesh's error of the fitted model changed, as a half width: base
    measurements do not know that part of the error, and with two meshes nothing tells what is left of it (the grid
    convergence index of Roache 1994, J. Fluids Eng. 116, with its factor of safety of 3). What registering clouds by
    the fitted model changed counts likewise. Where variance and weights were told anew windows agree better, also in
    what mesh and solver get wrong, of which nothing is known there: as they were weighed first they disagree by more,
    and the wider interval counts.
    """
    known = 0.0 if learned is None else learned.doubt(fit.columns, motions, fit.follow, fit.first)
    scale = at_the_end(fit.columns, fit.change)  # windows tell relative numbers from there
    retold = np.array([fit.by_retelling.get(column, 0.0) for column in fit.columns]) / scale
    known = np.hypot(known, retold / norm.ppf(0.5 + LEVEL / 2))
    doubts = known, np.hypot(known, fit.step)
    own, wide = half_widths(fit.asked, *doubts)
    if fit.weighed_first is not None:
        own, wide = np.maximum((own, wide), half_widths(fit.weighed_first, *doubts))
    below, above = np.where(fit.step < 0, wide, own), np.where(fit.step > 0, wide, own)
    found = {}
    for column, change, less, more in zip(fit.columns, fit.change, scale * below, scale * above, strict=True):
        value = change if column.entry is None else column.value(fit.model)
        low, high = value - less, value + more
        if column.entry is None:  # in proportion nothing changes sign
            low = max(low, -1.0)
        else:  # a drag is known to be none that drives
            low, high = max(low, column.declared.lower), min(high, column.declared.upper)
        found[column.name] = (float(value), float(low), float(high), column.unit)
    return found


def acts(fit: Fit, columns: Sequence[Column], learned: Learned | None, motions: int) -> bool:
    """Whether of some fitted numbers one that is zero where nothing acts surely is not; the rest as in
    :func:`intervals`."""
    told = intervals(fit, learned, motions)
    return any(low > 0 or high < 0 for _, low, high, _ in (told[name] for name in strengths(columns)))
