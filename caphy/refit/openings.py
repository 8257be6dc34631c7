"""Which openings of a cloth a fit is about: a waist that hardly moves does not tell what is sewn to it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caphy.refit.columns import Column
from caphy.refit.evidence import Evidence, inverse


def told(columns: Sequence[Column], known: Evidence, little: float) -> list[int]:
    """Places of the columns that are fitted: all, but openings without which the misfit is larger by no more than
    ``little``, all other numbers free. One of each effect stays.

    Backward elimination on the quadratic forms of windows, of what an effect calls ``separate``.
    """
    left = list(range(len(columns)))
    while many := _of_several(columns, left):
        normal, right = known.picked(left).normal
        covariance = inverse(normal)
        loss = np.divide(
            (covariance @ right) ** 2, np.diag(covariance), out=np.zeros(len(left)), where=np.diag(covariance) > 0
        )
        least = min(many, key=lambda place: loss[left.index(place)])
        if loss[left.index(least)] > little:
            break
        left.remove(least)
    return left


def _of_several(columns: Sequence[Column], left: Sequence[int]) -> list[int]:
    """Which of the columns that are left are an opening of an effect that has others left."""
    of = {place: columns[place].effect for place in left if columns[place].separate}
    names = list(of.values())
    return [place for place, name in of.items() if names.count(name) > 1]
