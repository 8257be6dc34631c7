"""What measurements in which nothing is missing teach about a model's mesh and solver."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from caphy.effects.model import Model
from caphy.refit.columns import Column


@dataclass(frozen=True, eq=False)
class Learned:
    """From base measurements, for every later comparison with measurements of the same cloth.

    Attributes:
        model: with parameters moved to where they asked for, if that was far.
        columns: every number of the library's.
        correction: how much of each column, by name, stands for what mesh and solver get wrong.
        variance: what is left in each mode at each lag (L, M) [m^2].
    """

    model: Model
    columns: tuple[Column, ...]
    correction: Mapping[str, float]
    variance: np.ndarray
