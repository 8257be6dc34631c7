"""The error on measurements that nothing was fitted to, before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import binom

from caphy.effects.model import Model
from caphy.refit.across import SURE, Across, across
from caphy.refit.borrowed import Few, where_few_decide
from caphy.refit.columns import Column, from_the_end
from caphy.refit.evidence import Weighing, tamed
from caphy.refit.fit import Fit, gone, summed
from caphy.refit.laws import Way
from caphy.refit.learned import Learned
from caphy.refit.responses import Response, median_mm, picked
from caphy.refit.study import Study

PROVEN = 1 / 3
"""Of the share of the misfit that a fit takes away: what it must take away on held-out measurements."""
FALLS = 0.97
"""Share of itself to which a median error must fall there to be proof enough."""
RISES = 1.01
"""Share of itself to which the median distance may rise in windows that a model was fitted to, by folds that snap."""
OUTWEIGHS = 3.0
"""Standard errors by which misfit must fall there and across motions to be proof though the median does not fall."""
BY_CHANCE = 0.05
"""Of so many windows' medians falling where each may as well rise: below it that is proof too."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Median distances of vertices from their measured places [mm], over all windows, frames and vertices.

    Attributes:
        before_mm, after_mm: of the model as it was, and as it is.
        floor_mm: what the noise of the measurement alone gives, of clouds at most; none if it is not known.
        before, after: median of each window (W,) [mm].
        share: of the misfit that is gone, as :func:`caphy.refit.fit.gone` tells it: finer than medians, which noise
            dominates.
        share_error: its standard error over windows.
        few: what must be exceeded instead, where few windows decide.
        across: what the fit takes away from one motion to another of those it was fitted to, if there are several.
        of_clouds: whether vertices were registered from clouds.
    """

    before_mm: float
    after_mm: float
    floor_mm: float | None
    before: np.ndarray
    after: np.ndarray
    share: float
    share_error: float
    few: Few | None = None
    across: Across | None = None
    of_clouds: bool = False

    @property
    def unchanged(self) -> HeldOut:
        """Where the model stays as it was after all."""
        return replace(
            self, after_mm=self.before_mm, after=self.before, share=0.0, share_error=0.0, few=None, across=None
        )

    @property
    def sign_test(self) -> float:
        """Probability of at least as many windows' medians falling, where each falls or rises by chance."""
        return _by_chance(self.after < self.before)

    @property
    def falls_surely(self) -> bool:
        """Whether the median falls by 3 %, or at all and in nearly all windows."""
        falls = self.after_mm < self.before_mm and self.sign_test < BY_CHANCE
        return falls or self.after_mm < FALLS * self.before_mm

    def proves(self, share: float) -> bool:
        """Whether what takes away a share of the misfit elsewhere holds here.

        The median error must fall, and the misfit must not rise. The median falls by 3 %, or the misfit falls by a
        third of that share or nearly so, and by two standard errors or in nearly all windows (a sign test of their
        medians: of five windows, a standard error is hardly known). What surely holds from one motion to another of
        those it was fitted to need not surely fall here, but by all of that third. Where few windows decide the misfit
        must fall by more than chance gives, and by a third of what it would fall by in these very windows. What is
        found where nothing is missing rarely does.

        A median that does not fall is outweighed by a misfit that falls by three standard errors, here and across
        motions: folds that snap move most vertices of a few windows, the truth's median may lie above that of a model
        without it.
        """
        if self.share < 0:
            return False
        if self.after_mm >= self.before_mm:
            return self.outweighs(share)
        if self.few is None:
            sure = self.share > SURE * self.share_error or self.sign_test < BY_CHANCE
            sure = sure and self.share + self.share_error >= PROVEN * share
            sure = sure or (self.across is not None and self.across.holds and self.share >= PROVEN * share)
        else:
            sure = self.share > self.few.chance and self.share >= PROVEN * self.few.promise
        return self.after_mm < FALLS * self.before_mm or sure

    def outweighs(self, share: float) -> bool:
        """Whether the fall of the misfit outweighs a median that does not fall, and does not surely rise either."""
        rises = self.before_mm < FALLS * self.after_mm or _by_chance(self.after > self.before) < BY_CHANCE
        if rises or self.few is not None or self.across is None or not self.across.holds:
            return False
        surely = self.share > OUTWEIGHS * self.share_error and self.across.share > OUTWEIGHS * self.across.error
        return surely and self.share >= PROVEN * share


def _by_chance(windows: np.ndarray) -> float:
    """Probability of at least as many of these windows (W,), each with probability 1/2."""
    return float(binom.sf(int(windows.sum()) - 1, len(windows), 0.5))


def rises_where_fitted(before: Sequence[Response], after: Sequence[Response]) -> str:
    """That what was fitted takes cloth away from where it was seen, in words; empty where it does not.

    Tangents tell what an effect takes away apart from folds that snap. Where these bring farther away what it brings
    nearer, held-out windows that happen to lie nearer are no proof.
    """
    was, now = median_mm(before), median_mm(after)
    return "" if now <= RISES * was else f"where it was fitted the median distance rises from {was:.2f} to {now:.2f} mm"


class Apart:
    """Windows that fits are judged on, and nothing is fitted to."""

    def __init__(
        self,
        study: Study,
        variance: np.ndarray,
        columns: Sequence[Column] = (),
        learned: Learned | None = None,
    ) -> None:
        """``learned`` from base measurements tells how much of ``columns`` to expect."""
        self.study, self.variance, self.columns, self.learned = study, variance, tuple(columns), learned
        self._before: tuple[object, Study, list[Response]] | None = None  # of the origin that was asked for last

    def registered_by(self, model: Model) -> Apart:
        """The same windows, clouds registered by another model."""
        return Apart(self.study.registered_by(model), self.variance, self.columns, self.learned)

    def errors(self, fitted: Fit) -> HeldOut:
        """Roll out a model before and after a fit.

        What errors of mesh and steps that are told of the fitted model take away counts beside what the change does by
        slopes, which know nothing of it: what a coarse mesh keeps a stiffness from doing may be more than what it does.
        """
        every = (*self.columns, *(column for column in fitted.columns if column not in self.columns))
        study, old = self._rolled_out(fitted.origin, every)
        told_before = study.respond(fitted.model, fitted.columns, "held-out windows")
        new = study.likewise().respond(fitted.model, fitted.columns, "held-out windows", anew={"solver"})
        known = picked(old, [every.index(column) for column in fitted.columns])
        weighing = Weighing.robust(known, self.variance)
        before = weighing.of(known)
        last = from_the_end(fitted.columns, fitted.change)
        after, told = (weighing.of(each) for each in (told_before, new))
        shares = gone(before, tamed(after, before), fitted.change, last)
        by_telling = before.weight * (after.c - told.c) / max(float((before.weight * before.c).sum()), 1e-300)
        rare = where_few_decide(before, known, self.variance, fitted.change)
        return self._held_out(old, new, *summed(shares + by_telling), rare, across(fitted))

    def of(self, model: Model) -> HeldOut:
        """Roll out a model to which nothing was done."""
        rolled = self.study.afresh().respond(model, (), "held-out windows", anew={"solver"})
        return self._held_out(rolled, rolled, 0.0, 0.0)

    def between(self, before: Model, after: Model) -> HeldOut:
        """Roll out two models of which nothing else is known; their misfits are compared as they are."""
        study = self.study.afresh()
        new, old = (study.respond(each, (), "held-out windows", anew={"solver"}) for each in (after, before))
        plain = [picked(each, ()) for each in (old, new)]
        weighing = Weighing.robust(plain[0], self.variance)
        was, now = (weighing.of(each) for each in plain)
        fell, whole = was.weight * (was.c - now.c), float((was.weight * was.c).sum())
        error = np.sqrt(len(fell)) * fell.std(ddof=1) / whole if len(fell) > 1 else np.inf
        return self._held_out(old, new, float(fell.sum()) / whole, float(error))

    def _held_out(
        self,
        old: Sequence[Response],
        new: Sequence[Response],
        share: float,
        error: float,
        few: Few | None = None,
        elsewhere: Across | None = None,
    ) -> HeldOut:
        errors = [[1e3 * response.error for response in each] for each in (old, new)]
        medians = [np.array([np.nanmedian(window) for window in each]) for each in errors]
        pooled = [float(np.nanmedian(np.concatenate([window.ravel() for window in each]))) for each in errors]
        clouds = self.study.of_clouds
        return HeldOut(
            pooled[0], pooled[1], self.study.floor_mm, medians[0], medians[1], share, error, few, elsewhere, clouds
        )

    def falls(self, way: Way, origin: Model) -> np.ndarray:
        """By how much the misfit of each window (W,) falls on a way, by weights as they were at an ``origin``."""
        study, old = self._rolled_out(origin, self.columns)
        return way.falls(study.likewise(), Weighing.robust(picked(old, range(len(self.columns))), self.variance))

    def _rolled_out(self, origin: Model, columns: tuple[Column, ...]) -> tuple[Study, list[Response]]:
        """Windows against the model that a fit began with, which most fits have in common, and what knows them."""
        which = origin.to_json(), columns
        if self._before is None or self._before[0] != which:
            study = self.study.afresh()
            old = study.respond(origin, columns, "held-out windows", anew={"solver"})
            known = {} if self.learned is None else self.learned.correction_in(old, columns)
            self._before = which, study, study.correct(old, columns, known)
        return self._before[1:]
