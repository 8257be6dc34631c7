"""A model fitted to windows, and what of their misfit that takes away."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from caphy.effects.model import Model
from caphy.refit.columns import Column, at_the_end, changes, extended, from_the_end, moved
from caphy.refit.evidence import Evidence, Weighing, borne_out, bounded, tamed
from caphy.refit.responses import Response

FURTHEST = 10.0
"""Factor by which proportional numbers may grow or shrink in all."""

SNAPPED = 2.0
"""Times its first misfit: what a window may count at most."""

LARGE = 0.3
"""Share of the misfit beyond which roll-outs tell it better than tangents."""

_AT_ODDS = 0.1  # likewise where tangents from either side differ by so much of the misfit
_SETTLED = 1e-3  # of what the whole change takes away: what a further step must promise; 3 % of the numbers
_NOTHING = 1e-5  # of the misfit: a promise that is none


@dataclass(frozen=True, eq=False)
class Fit:
    """A model fitted to windows.

    Attributes:
        origin: the model that was given.
        model: with the fitted numbers.
        columns: what was fitted.
        first: what the windows said at the origin, in these columns.
        responses: the windows at the fitted model, in these columns.
        evidence: what they say.
        misfit: weighted chi2 over all windows; a window that gets much worse than it was at the origin counts no more
            than twice that, because a fold that snaps the other way says nothing of the numbers.
        most: what each window may count at most (W,).
        weighing: what windows were weighed by.
        converged: whether another step promised nothing.
        follow: of columns that screens do not know, what those of the effect that theirs refines do to them.
        by_retelling: how far columns, also some that are fitted no more, went because the mesh's error was told of the
            fitted model, or clouds were registered by it.
        weighed_first: what windows said before variance and weights were told anew, where they were.
        windows: the windows at the origin, in these columns; none where its tangents are no instruments.
        by_instruments: what windows still ask for by tangents of the origin (:func:`asked_by_instruments`), where the
            fit takes away less than 30 % of the misfit and its own tangents snap.
    """

    origin: Model
    model: Model
    columns: tuple[Column, ...]
    first: Evidence
    responses: list[Response]
    evidence: Evidence
    misfit: float
    most: np.ndarray
    weighing: Weighing
    converged: bool = False
    follow: Mapping[Column, Mapping[Column, float]] = field(default_factory=dict)
    by_retelling: Mapping[Column, float] = field(default_factory=dict)
    weighed_first: Evidence | None = None
    windows: tuple[Response, ...] = ()
    by_instruments: Evidence | None = None

    @property
    def asked(self) -> Evidence:
        """What windows still ask for: by instruments where these tell it, else by the fit's own tangents."""
        return self.evidence if self.by_instruments is None else self.by_instruments

    @property
    def change(self) -> np.ndarray:
        """Of each number since the origin (K,)."""
        return changes(extended(self.origin, self.columns), self.model, self.columns)

    @property
    def share(self) -> float:
        """Of the misfit, what the fit takes away."""
        return share_gone(self.first, self.evidence, self.change, from_the_end(self.columns, self.change))[0]

    @property
    def step(self) -> np.ndarray:
        """The change (K,) that the windows still ask for; proportional ones of at most a factor of three at a time, and
        of :data:`FURTHEST` in all."""
        return self.longer_step(1.0)

    def longer_step(self, factor: float) -> np.ndarray:
        """Of some times the length of :attr:`step` where that stays within the same bounds."""
        limits = [
            (max(-0.6, 1 / FURTHEST / (1 + so_far) - 1), min(2.0, FURTHEST / (1 + so_far) - 1))
            if c.entry is None
            else c.bounds(self.model)
            for c, so_far in zip(self.columns, self.change, strict=True)
        ]
        lower, upper = np.array(limits).reshape(-1, 2).T
        normal, right = self.asked.normal
        return bounded(normal, factor * right, lower, upper)

    def ahead(self, change: np.ndarray) -> Model:
        """The model at another change (K,) since the origin, as told by steps so far: of proportional numbers of at
        most :data:`FURTHEST` either way, beyond which such a line may cross zero."""
        bounds = (1 / FURTHEST - 1, FURTHEST - 1)
        kept = [np.clip(by, *bounds) if c.entry is None else by for c, by in zip(self.columns, change, strict=True)]
        return moved(self.origin, self.columns, np.array(kept))

    @property
    def promise(self) -> float:
        """By how much that change should lower the misfit."""
        (normal, right), step = self.asked.normal, self.step
        return float(2 * step @ right - step @ normal @ step)

    @property
    def settled(self) -> bool:
        """Whether the step that is left is small beside the change so far, where the windows can tell."""
        normal, change = self.asked.normal[0], from_the_end(self.columns, self.change)
        # Curvatures that have exploded since the origin say that all has been done; no fit takes more than was there.
        whole = min(float(change @ normal @ change), float((self.first.weight * self.first.c).sum()))
        return self.promise < max(_SETTLED * whole, _NOTHING * self.misfit)


def judged(
    origin: Model,
    model: Model,
    columns: tuple[Column, ...],
    responses: list[Response],
    weighing: Weighing,
    most: np.ndarray | None = None,
    first: Evidence | None = None,
    windows: Sequence[Response] = (),
    snaps: bool = False,
) -> Fit:
    """Of responses at a model, fitted from an origin; ``first`` is the evidence there, unless it is that model, and
    ``windows`` the responses, where they are known. ``snaps`` where tangents were seen to snap on the way.

    ``most`` is what each window may count at most (W,); twice what it does here unless given.
    """
    known = weighing.of(responses)
    each = known.weight * known.c
    most = SNAPPED * each if most is None else most
    known = replace(known, weight=known.weight * np.minimum(1, most / np.maximum(each, 1e-300)))
    misfit = float((known.weight * known.c).sum())
    if first is None:
        return Fit(origin, model, columns, known, responses, known, misfit, most, weighing, windows=tuple(windows))
    change = changes(extended(origin, columns), model, columns)
    own = borne_out(tamed(known, first), first, change, from_the_end(columns, change))
    found = Fit(origin, model, columns, first, responses, own, misfit, most, weighing, windows=tuple(windows))
    if not windows or not change.any() or found.share >= LARGE:
        return found
    return replace(found, by_instruments=asked_by_instruments(found, snaps))


_SLOPES = 0.02, 4.0  # of what more of a number does at a fit, over what its first bit does: what is believed
_IN_COMMON = 0.3  # squared cosine of what tangents here and at the origin do: beyond it they snap little


def asked_by_instruments(found: Fit, snaps: bool = False) -> Evidence | None:
    """What windows still ask for, by tangents of where the fit began; none where its own have much in common with them,
    and had on the way, or a fit would go to and fro between what either asks for.

    Where cloth is about to snap a roll-out and its own tangents go wrong together, and what these find in its residual
    is in part the same chaos twice, which asks to stay: of a skirt's heavy hem half was missing, wherever a fit began.
    Tangents of the origin know nothing of that. As instruments (Reiersol 1945; Sargan, Econometrica 26, 1958: the
    remedy for errors in variables) they tell when no more is asked for. How much a number does by now over what its
    first bit did is told by what it has taken away so far, or by its own tangents where these say less.
    """
    many, unit = len(found.columns), at_the_end(found.columns, found.change)
    both = [
        replace(now, columns=np.concatenate([then.columns * unit, now.columns], axis=-1))
        for then, now in zip(found.windows, found.responses, strict=True)
    ]
    weight = found.evidence.weight  # here, where what snapped counts as little
    every = replace(found.weighing, weight=weight).of(both)
    known, change = every.picked(range(many)), found.change / unit
    (normal, right), by_own = known.normal, every.normal[0][:, many:]
    whole, local, own = (float(change @ part @ change) for part in (normal, by_own[:many], by_own[many:]))
    if not snaps and local**2 > _IN_COMMON * whole * own:
        return None
    asked_first = unit * (weight @ found.first.b)
    so_far = float(change @ (asked_first - right)) / max(whole, 1e-300)
    slope = min(so_far, local / max(whole, 1e-300)) if local > 0 else so_far
    slope = float(np.clip(slope, *_SLOPES))
    return replace(known, a=slope**2 * known.a, b=slope * known.b)  # tangents of the origin, at their length here


def falls_evenly(before: Evidence, after: Evidence, change: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
    """By how much the misfit of each window (W,) falls with a change (K,), by tangents at either end.

    ``last`` is the same change as it is counted there (:func:`caphy.refit.columns.from_the_end`).

    The misfits of two roll-outs differ by more than small effects do, because folds snap here in one and there in the
    other. Slopes b and curvatures A at either end tell what the change d itself does. With responses S that change
    evenly from one end to the other the residual moves by m = (S0 + S1) d / 2, and the misfit falls by

        2 e0.m - m.m = d.(b0 + b1) - d.(A0 - A1) d / 4.
    """
    (slope, curvature), (last_slope, last_curvature) = (
        before.along(change),
        after.along(change if last is None else last),
    )
    return -(slope + last_slope) / 2 - (curvature - last_curvature) / 8


def share_gone(
    before: Evidence, after: Evidence, change: np.ndarray, last: np.ndarray | None = None
) -> tuple[float, float]:
    """The share of the misfit that a change (K,) takes away, by :func:`gone`, and its standard error: that of a sum
    over windows."""
    return summed(gone(before, after, change, last))


def summed(shares: np.ndarray) -> tuple[float, float]:
    """The sum over windows (W,) and its standard error."""
    return float(shares.sum()), float(np.sqrt(len(shares)) * shares.std(ddof=1)) if len(shares) > 1 else np.inf


def gone(before: Evidence, after: Evidence, change: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
    """Shares (W,) of the whole misfit that a change (K,) takes away in each window, as by :func:`falls_evenly`.

    Where it takes away more than 30 % tangents do not reach from one end to the other, and roll-outs tell. Where the
    ends are at odds (viscosity does less and less the more there is of it) roll-outs tell too, but no less than the
    lesser of what either end promises and no more than the greatest of all three; of what soon does no more tangents
    where it begins promise harm, and the best part of the way by them is the most.
    """
    zero = np.zeros_like(change)
    old, new = before.misfit(zero), after.misfit(zero)
    total = max(float(old.sum()), 1e-300)
    (slope, curvature), (last_slope, last_curvature) = (
        before.along(change),
        after.along(change if last is None else last),
    )
    ends = -(slope + curvature / 2).sum(), -(last_slope - last_curvature / 2).sum()
    part = max(-slope.sum(), 0.0) ** 2 / (2 * curvature.sum()) if ends[0] < 0 else 0.0
    evenly, falls = falls_evenly(before, after, change, last), old - new
    if new.sum() >= (1 - LARGE) * old.sum():
        if abs(ends[0] - ends[1]) <= _AT_ODDS * total:
            falls = evenly
        else:
            falls += (np.clip(falls.sum(), min(ends), max(*ends, evenly.sum(), part)) - falls.sum()) / len(falls)
    return falls / total
