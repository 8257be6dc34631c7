"""What measurements in which nothing is missing teach about a model's mesh and solver."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.effects.model import Model
from caphy.refit.columns import Column
from caphy.refit.evidence import Evidence, evidence, ridged
from caphy.refit.responses import Response

REACH = 10.0
"""Times the curvature that a number has in windows of the base, in the mean: up to which they teach what to expect."""


@dataclass(frozen=True, eq=False)
class Learned:
    """From base measurements, for every later comparison with measurements of the same cloth.

    Attributes:
        model: with parameters moved to where they asked for, if that was far.
        columns: every number of the library's.
        correction: how much of each column, by name, stands for what mesh and solver get wrong.
        variance: what is left in each mode at each lag (L, M) [m^2].
        told: what the W windows say in these columns.
        motions: which measurement each window is of, (W,).
        ridge: how much corrections are shrunk.
        mesh: how much of what a finer mesh does otherwise is in all windows.
    """

    model: Model
    columns: tuple[Column, ...]
    correction: Mapping[str, float]
    variance: np.ndarray
    told: Evidence
    motions: np.ndarray
    ridge: float
    mesh: float

    def correction_in(self, responses: Sequence[Response], columns: Sequence[Column]) -> dict[str, float]:
        """How much of each column to expect in windows, by name; ``columns`` are the first of the responses'.

        Where these windows have more than :data:`REACH` times the curvature of the base's, a correction is shrunk in
        proportion. One window of a base that brushed a ball told a friction of -0.47, which is nothing there; where
        cloth rests on the ball it was five sixths of all that windows missed.
        """
        places = [(place, columns.index(column)) for place, column in enumerate(self.columns) if column in columns]
        own, here = ([pair[k] for pair in places] for k in (0, 1))
        known = [replace(response, columns=response.columns[..., here]) for response in responses]
        held = self._held(own, _curvature(evidence(known, self.variance)))
        names = [self.columns[k].name for k in own]
        return {name: self.correction[name] * by for name, by in zip(names, held.tolist(), strict=True)}

    def _held(self, places: Sequence[int], curvature: np.ndarray) -> np.ndarray:
        """Shares of what the base tells of its columns at ``places`` that hold in windows of other curvature (K,)."""
        known = REACH * _curvature(self.told)[list(places)]
        return np.where(curvature > known, known / np.maximum(curvature, 1e-300), 1.0)

    def doubt(
        self,
        columns: Sequence[Column],
        count: int,
        follow: Mapping[Column, Mapping[Column, float]] | None = None,
        known: Evidence | None = None,
    ) -> np.ndarray:
        """Standard errors (K,) of numbers fitted to ``count`` motions, by what mesh and solver get wrong in them.

        Each base motion in turn is corrected by the others, and the numbers are fitted to what is left, where they
        should be zero: that is how far a motion can lead them astray. The correction itself counts as an error beside
        it, since how much of it holds where the cloth moves otherwise is not known.

        Args:
            follow: for columns that base measurements do not know, those that they do know, and how far one unit of
                each leads astray.
            known: the windows that numbers are fitted to, in ``columns``: where these are moved far more than the
                base's, errors are taken to be as large beside what windows tell, not beside the number.
        """
        meant = [(follow or {}).get(column, {column: 1.0}) for column in columns]
        places = sorted({self.columns.index(other) for each in meant for other in each if other in self.columns})
        if not places:
            return np.zeros(len(columns))
        by = np.array([[each.get(self.columns[place], 0.0) for place in places] for each in meant])
        found = by @ np.array([self._left_in(motion, places) for motion in np.unique(self.motions)]).T
        corrected = by @ [self.correction.get(self.columns[place].name, 0.0) for place in places]
        doubts = np.hypot(np.sqrt((found**2).mean(axis=1) / count), corrected)
        if known is not None:
            same = [k for k, column in enumerate(columns) if column in self.columns and meant[k] == {column: 1.0}]
            own = [self.columns.index(columns[k]) for k in same]
            doubts[same] *= np.sqrt(self._held(own, _curvature(known)[same]))
        return doubts

    def _left_in(self, motion: int, places: Sequence[int]) -> np.ndarray:
        """Numbers fitted to one motion corrected by all the others."""
        own = self.told.weight * (self.motions == motion)
        rest = self.told.weight - own
        correction = ridged(*self._sums(rest), self.ridge)
        normal, right = self._sums(own)
        right = right - normal @ correction
        return ridged(normal[np.ix_(places, places)], right[places], 1e-6)

    def _sums(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.einsum("w,wkl->kl", weight, self.told.a), weight @ self.told.b


def _curvature(known: Evidence) -> np.ndarray:
    """Mean over windows of each number's own curvature (K,)."""
    return np.einsum("wkk->k", known.a) / len(known.a)
