"""What measurements in which nothing is missing teach about a model's mesh and solver."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caphy.effects.model import Model
from caphy.refit.columns import Column
from caphy.refit.evidence import Evidence, ridged


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

    def doubt(
        self, columns: Sequence[Column], count: int, follow: Mapping[Column, Mapping[Column, float]] | None = None
    ) -> np.ndarray:
        """Standard errors (K,) of numbers fitted to ``count`` motions, by what mesh and solver get wrong in them.

        Each base motion in turn is corrected by the others, and the numbers are fitted to what is left, where they
        should be zero: that is how far a motion can lead them astray. The correction itself counts as an error beside
        it, since how much of it holds where the cloth moves otherwise is not known.

        Args:
            follow: for columns that base measurements do not know, those that they do know, and how far one unit of
                each leads astray.
        """
        meant = [(follow or {}).get(column, {column: 1.0}) for column in columns]
        places = sorted({self.columns.index(other) for each in meant for other in each if other in self.columns})
        if not places:
            return np.zeros(len(columns))
        by = np.array([[each.get(self.columns[place], 0.0) for place in places] for each in meant])
        found = by @ np.array([self._left_in(motion, places) for motion in np.unique(self.motions)]).T
        corrected = by @ [self.correction.get(self.columns[place].name, 0.0) for place in places]
        return np.hypot(np.sqrt((found**2).mean(axis=1) / count), corrected)

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
