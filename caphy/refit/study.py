"""Windows of several measurements, and fits of a model's numbers to them by Gauss-Newton on real roll-outs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from caphy.effects.model import Model
from caphy.errors import CaphyError, Diverged
from caphy.measure.noise import measurement_noise
from caphy.measure.scene import Scene
from caphy.measure.track import Progress
from caphy.measure.windows import LENGTH
from caphy.refit.clouds import all_registered
from caphy.refit.columns import Column, changes, extended, from_the_end, moved
from caphy.refit.crew import Crew, Place
from caphy.refit.evidence import (
    KINDS,
    Evidence,
    borne_out,
    bounded,
    estimated_variance,
    evidence,
    robust_weights,
    tamed,
)
from caphy.refit.responses import Response, Watched, watched
from caphy.refit.tangents import Pushes

FEWEST = 4
"""Windows without which nothing can be told."""

_SHORTER = 0.4
ROUNDS = 7
"""Gauss-Newton steps that are taken in any case, as long as one promises something."""
_MOST_ROUNDS, _STILL_FALLS = 40, 0.01  # in all at most, and of the misfit what each further one must take away
_WEIGHED = 3  # times that variance and weights are told anew
_MORE_THAN_PROMISED, _LONGEST = 1.5, 4.0  # times a promise: a fall after which the next step is longer, times at most

RETELLINGS = 3
"""Times at most that the mesh's error is told of a fitted model."""

_AGREE = 0.9  # cosine of two steps between retellings beyond which they are of one way
_SHRINKS = 0.8  # factor from one to the next that is believed at most
_SETTLED = 1e-3  # of what the whole change takes away: what a further step must promise; 3 % of the numbers
_NOTHING = 1e-5  # of the misfit: a promise that is none

FURTHEST = 10.0
"""Factor by which proportional numbers may grow or shrink in all."""

SNAPPED = 2.0
"""Times its first misfit: what a window may count at most."""
_LARGE = 0.3  # share of the misfit beyond which roll-outs tell it better than tangents
_AT_ODDS = 0.1  # likewise where tangents from either side differ by so much of the misfit
_ROUGH = 0.05  # of the misfit: what differs between roll-outs of almost the same model, because folds snap
_FUTILE = 0.03  # of the misfit: a promise that, once broken, is not worth a shorter step


class Study:
    """The windows of some measurements."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        length: int = LENGTH,
        progress: Progress | None = None,
        crew: Crew | None = None,
        mesh: float | None = None,
        like: Study | None = None,
    ) -> None:
        """``crew`` rolls windows out, this process does unless given. ``mesh`` is how much of the mesh's error is in
        all windows, where that is known; it is free in each unless given. What is known of the windows of a study
        ``like`` it, of the same motions, holds here.

        Raises :class:`CaphyError` where there are too few windows, or some scenes were registered from clouds alone.
        """
        if len({scene.slides for scene in scenes}) > 1:
            raise CaphyError(KINDS)
        self.scenes, self.length, self.progress, self.crew = tuple(scenes), length, progress, crew
        self.mesh = mesh
        self.why_not = ""
        """Why its clouds could not be registered by another model, where that was tried."""
        self.watched = watched(scenes, length, None if like is None else like.watched)
        self._expected: list[np.ndarray] | None = None
        self.starts = [each.starts() for each in self.watched]
        if sum(map(len, self.starts)) < FEWEST:
            names = ", ".join(scene.measurement.source or scene.measurement.name for scene in scenes)
            raise CaphyError(
                f"{names}: needs at least {FEWEST} windows of {length} frames, each with half of the vertices seen "
                f"around its start, got {sum(map(len, self.starts))}; measure longer motions"
            )
        self._known_as = None if crew is None else crew.learn(self.scenes, length, like and like._known_as)

    @property
    def on_body(self) -> bool:
        """Whether cloth meets a body in any of the scenes."""
        return any(each.scene.motion is not None for each in self.watched)

    @property
    def noise(self) -> float:
        """Standard deviation of a mode's coefficient by the noise of the measurements [m], the largest of them."""
        found = []
        for each in self.watched:
            noise = measurement_noise(each.scene.measurement)
            found.append(0.0 if noise is None else noise.sigma / np.sqrt(len(each.scene.garment.vertices)))
        return max(found)

    @property
    def floors_mm(self) -> list[float]:
        """Median distance from the truth by noise alone, in each scene where it is known [mm]."""
        noise = [(measurement_noise(each.scene.measurement), each.scene.slides) for each in self.watched]
        return [1e3 * (n.median_across if slides else n.median) for n, slides in noise if n is not None]

    def respond(
        self,
        model: Model,
        columns: Sequence[Column],
        what: str = "rolling out",
        pushes: Callable[[Watched], Pushes] | None = None,
        anew: Collection[str] = (),
        free: bool = False,
    ) -> list[Response]:
        """All windows against a model.

        Args:
            pushes: makes further forces, of no effect, to respond to.
            anew: errors to tell of this model even where an earlier one's are known: "start", and "solver", those of
                time step and mesh. The latter only where it is known how much the mesh does: a coarse one gives in less
                to a strong effect too, so that more of an error told anew and more of the effect would look alike.
            free: leave the mesh's error free in each window, to learn how much of it is there; all of ``anew`` is told.
        """
        places = [(number, frame) for number, starts in enumerate(self.starts) for frame in starts]
        found: dict[int, Response] = {}
        told = frozenset(anew) if free or self.mesh is not None else frozenset(anew) - {"solver"}
        for place, response in self._responses(places, model, columns, pushes, told):
            wrong = 0.0 if self._expected is None else self._expected[place]
            known = response if free or self.mesh is None else response.with_mesh(self.mesh)
            found[place] = replace(known, residual=known.residual - wrong)
            if self.progress is not None:
                self.progress(what, len(found), len(places))
        return [found[place] for place in range(len(places))]

    def _responses(
        self,
        places: Sequence[Place],
        model: Model,
        columns: Sequence[Column],
        pushes: Callable[[Watched], Pushes] | None,
        errors: frozenset[str],
    ) -> Iterator[tuple[int, Response]]:
        if self.crew is not None and self._known_as is not None:
            yield from self.crew.respond(self._known_as, places, model, columns, pushes, errors)
            return
        first = 0
        for each, starts in zip(self.watched, self.starts, strict=True):
            forces = None if pushes is None else pushes(each)
            yield from enumerate(each.respond(model, columns, starts, forces, errors), first)
            first += len(starts)

    def correct(
        self, responses: Sequence[Response], columns: Sequence[Column], known: Mapping[str, float]
    ) -> list[Response]:
        """Take from residuals, in these responses and all to come, what base measurements taught to expect, in place of
        what was expected before.

        Args:
            columns: the first of the responses'.
            known: how much of each column, by name, stands for what mesh and solver get wrong.
        """
        change = np.array([known.get(column.name, 0.0) for column in columns])
        before = self._expected or [np.zeros_like(response.residual) for response in responses]
        self._expected = [response.columns[..., : len(change)] @ change for response in responses]
        return [
            replace(response, residual=response.residual + old - new)
            for response, old, new in zip(responses, before, self._expected, strict=True)
        ]

    def afresh(self) -> Study:
        """The same windows, of which nothing is known yet."""
        other = Study(self.scenes, self.length, self.progress, self.crew, self.mesh)
        other.starts = list(self.starts)
        return other

    def registered_by(self, model: Model) -> Study:
        """The same windows, clouds registered by another model; what is known of them holds. This study itself where
        that model does not follow its clouds, which :attr:`why_not` says, or there are none."""
        if not any(scene.slides for scene in self.scenes):
            return self
        try:
            clouds = [scene.unregistered for scene in self.scenes]
            scenes = all_registered(clouds, model, self.progress, self.crew)
            other = Study(scenes, self.length, self.progress, self.crew, self.mesh, self)
        except CaphyError as error:
            self.why_not = str(error)
            return self
        seen = [set(starts) for starts in other.starts]
        kept = [start in seen[number] for number, starts in enumerate(self.starts) for start in starts]
        if sum(kept) < FEWEST:
            self.why_not = f"only {sum(kept)} of {len(kept)} windows would be left"
            return self
        other.starts = [[s for s in starts if s in there] for starts, there in zip(self.starts, seen, strict=True)]
        if self._expected is not None:
            other._expected = [e for e, there in zip(self._expected, kept, strict=True) if there]
        return other

    def variance(self, responses: Sequence[Response]) -> np.ndarray:
        """The variance (L, M) [m^2] that nothing explains."""
        return estimated_variance(responses, self.noise)


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
        converged: whether another step promised nothing.
        follow: of columns that screens do not know, what those of the effect that theirs refines do to them.
        by_retelling: how far columns, also some that are fitted no more, went because the mesh's error was told of the
            fitted model, or clouds were registered by it.
        weighed_first: what windows said before variance and weights were told anew, where they were.
    """

    origin: Model
    model: Model
    columns: tuple[Column, ...]
    first: Evidence
    responses: list[Response]
    evidence: Evidence
    misfit: float
    most: np.ndarray
    converged: bool = False
    follow: Mapping[Column, Mapping[Column, float]] = field(default_factory=dict)
    by_retelling: Mapping[Column, float] = field(default_factory=dict)
    weighed_first: Evidence | None = None

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
        normal, right = self.evidence.normal
        return bounded(normal, factor * right, lower, upper)

    @property
    def promise(self) -> float:
        """By how much that change should lower the misfit."""
        (normal, right), step = self.evidence.normal, self.step
        return float(2 * step @ right - step @ normal @ step)

    @property
    def settled(self) -> bool:
        """Whether the step that is left is small beside the change so far, where the windows can tell."""
        normal, change = self.evidence.normal[0], self.change
        # Curvatures that have exploded since the origin say that all has been done; no fit takes more than was there.
        whole = min(float(change @ normal @ change), float((self.first.weight * self.first.c).sum()))
        return self.promise < max(_SETTLED * whole, _NOTHING * self.misfit)


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
    """The share of the misfit that a change (K,) takes away, as by :func:`falls_evenly`, and its standard error.

    Where it takes away more than 30 % tangents do not reach from one end to the other, and roll-outs tell. Where the
    ends are at odds (viscosity does less and less the more there is of it) roll-outs tell too, but no less than the
    lesser of what either end promises and no more than the greatest of all three. The error is that of a sum over
    windows.
    """
    zero = np.zeros_like(change)
    old, new = before.misfit(zero), after.misfit(zero)
    total = max(float(old.sum()), 1e-300)
    (slope, curvature), (last_slope, last_curvature) = (
        before.along(change),
        after.along(change if last is None else last),
    )
    ends = -(slope + curvature / 2).sum(), -(last_slope - last_curvature / 2).sum()
    evenly, falls = falls_evenly(before, after, change, last), old - new
    if new.sum() >= (1 - _LARGE) * old.sum():
        if abs(ends[0] - ends[1]) <= _AT_ODDS * total:
            falls = evenly
        else:
            falls += (np.clip(falls.sum(), min(ends), max(*ends, evenly.sum())) - falls.sum()) / len(falls)
    falls = falls / total
    return float(falls.sum()), float(np.sqrt(len(falls)) * falls.std(ddof=1)) if len(falls) > 1 else np.inf


def fit(
    study: Study,
    model: Model,
    columns: Sequence[Column],
    responses: Sequence[Response],
    variance: np.ndarray,
    weight: np.ndarray,
    what: str = "fitting",
    rounds: int | None = None,
    most: np.ndarray | None = None,
) -> Fit:
    """Change numbers of a model so that its roll-outs meet the windows.

    Gauss-Newton, with shorter steps where one makes things worse; bounds are kept. Windows start where the measurement
    says, whatever the model: starts that followed the fit would make any fit look better than none.

    Args:
        responses: of the model as given, in these columns.
        variance: of each mode at each lag (L, M) [m^2].
        weight: of each window (W,).
        rounds: steps at most; as many as are of use unless given.
        most: what each may count at most (W,); :data:`SNAPPED` times what it does at the start unless given.
    """
    columns = tuple(columns)
    start = _judged(model, model, columns, list(responses), variance, weight, most)
    return refined(study, start, variance, weight, what, rounds)


def refined(
    study: Study,
    best: Fit,
    variance: np.ndarray,
    weight: np.ndarray,
    what: str = "fitting",
    rounds: int | None = None,
    enough: float = 0.0,
) -> Fit:
    """A fit carried on until it has settled, or another step promises no more than ``enough`` of the misfit.

    Without ``rounds`` a fit that still falls goes on, or it would end on its way: the more there is of a drag the less
    a further bit of it does, so that steps towards a strong one are short. Where the misfit falls by more than was
    promised the next step is twice as long as it would be, after another such one four times.
    """
    step, fell, longer = best.step, 1.0, 1.0
    for done in range(_MOST_ROUNDS if rounds is None else rounds):
        if rounds is None and done >= ROUNDS and fell < _STILL_FALLS:
            return best
        there = moved(best.model, best.columns, step)
        found = tried(study, best, there, variance, weight, what)
        before = max(best.misfit, 1e-300)
        fell = 0.0 if found is None else 1 - found.misfit / before
        if found is not None and fell > -_ROUGH:
            more = fell > max(_STILL_FALLS, _MORE_THAN_PROMISED * best.promise / before)
            longer = min(2 * longer, _LONGEST) if more else 1.0
            best, step = found, found.longer_step(longer)
            if best.settled and not more:
                return replace(best, converged=True)
            if best.promise < enough * best.misfit:
                return best
        elif best.promise < _FUTILE * best.misfit:
            return best
        else:
            step = _SHORTER * step
    return best


def weighed_anew(study: Study, best: Fit, what: str = "weighing anew") -> Fit:
    """A fit that took a large part of the misfit away, carried on with variance and weights that are told by what it
    leaves over.

    Those of the model that it began with were told where a strong effect was missing, and its tangents explained only a
    part of that: what they did not looks like noise, most in windows and at lags in which the effect did most. So far a
    drag of 3.0 was told as 2.4. Weights that follow the fit are iteratively reweighted least squares (Holland, Welsch,
    Commun. Stat. A 6, 1977).
    """
    if best.share < _LARGE:
        return best
    old = best.evidence
    origin = study.respond(best.origin, best.columns, what)
    for _ in range(_WEIGHED):
        variance = study.variance(best.responses)
        weight = robust_weights(evidence(best.responses, variance))
        first = evidence(origin, variance, weight)
        best = _judged(best.origin, best.model, best.columns, best.responses, variance, weight, None, first)
        if best.settled:
            best = replace(best, converged=True)
            break
        best = refined(study, best, variance, weight, what)
    return replace(best, weighed_first=old)


def tried(
    study: Study,
    best: Fit,
    there: Model,
    variance: np.ndarray,
    weight: np.ndarray,
    what: str,
    anew: Collection[str] = (),
) -> Fit | None:
    """A fit moved to another model, or none where cloth flies apart there."""
    try:
        responses = study.respond(there, best.columns, what, anew=anew)
    except Diverged:
        return None
    return _judged(best.origin, there, best.columns, responses, variance, weight, best.most, best.first)


def retold(
    study: Study, best: Fit, variance: np.ndarray, weight: np.ndarray, what: str = "what the mesh does now"
) -> Fit:
    """A fit carried on with the mesh's error told of the fitted model, where it is known how much of it is there.

    A coarse mesh does not answer a stiffness or a damping as the cloth does; how its error changes with the fit tells
    what is between them. Each time the numbers go a part of the way that was left: after two of them, to its end.
    """
    if study.mesh is None:
        return best
    path, there, before = [best.change], best.model, best.by_retelling
    for _ in range(RETELLINGS):
        told = tried(study, best, there, variance, weight, what, {"solver"})
        if told is None:
            break
        best = told
        if best.settled:
            best = replace(best, converged=True)
            break
        best = refined(study, best, variance, weight, what)
        path.append(best.change)
        further = _way_left(path, best.evidence.normal[0])
        there = moved(best.origin, best.columns, best.change + further) if further.any() else best.model
    return replace(best, by_retelling=gone_further(before, best.columns, best.change - path[0]))


def gone_further(before: Mapping[Column, float], columns: Sequence[Column], change: np.ndarray) -> dict[Column, float]:
    """:attr:`Fit.by_retelling` of columns that went by a further ``change`` (K,)."""
    return {c: float(np.hypot(by, before.get(c, 0.0))) for c, by in zip(columns, change, strict=True)}


def _way_left(path: Sequence[np.ndarray], metric: np.ndarray) -> np.ndarray:
    """From the last of some changes (K,) to where steps that shrink by one factor lead (Aitken 1926); zero unless two
    steps agree in direction, by a ``metric`` (K, K)."""
    if len(path) < 3:
        return np.zeros_like(path[-1])
    before, last = path[-2] - path[-3], path[-1] - path[-2]
    along, square = float(before @ metric @ last), float(before @ metric @ before)
    cosine = along / np.sqrt(max(square * float(last @ metric @ last), 1e-300))
    if cosine < _AGREE:
        return np.zeros_like(last)
    ratio = min(along / square, _SHRINKS)
    return ratio / (1 - ratio) * last


def picked(responses: Sequence[Response], columns: Sequence[int]) -> list[Response]:
    """The same windows with some of the columns."""
    index = list(columns)
    return [replace(response, columns=response.columns[..., index]) for response in responses]


def _judged(
    origin: Model,
    model: Model,
    columns: tuple[Column, ...],
    responses: list[Response],
    variance: np.ndarray,
    weight: np.ndarray,
    most: np.ndarray | None = None,
    first: Evidence | None = None,
) -> Fit:
    known = evidence(responses, variance, weight)
    each = known.weight * known.c
    most = SNAPPED * each if most is None else most
    known = replace(known, weight=known.weight * np.minimum(1, most / np.maximum(each, 1e-300)))
    misfit = float((known.weight * known.c).sum())
    if first is None:
        return Fit(origin, model, columns, known, responses, known, misfit, most)
    change = changes(extended(origin, columns), model, columns)
    known = borne_out(tamed(known, first), first, change, from_the_end(columns, change))
    return Fit(origin, model, columns, first, responses, known, misfit, most)
