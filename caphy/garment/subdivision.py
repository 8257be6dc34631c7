"""A garment's mesh with each face cut in four, the same cloth otherwise: how the answer depends on the mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caphy.garment.template import Garment
from caphy.garment.topology import edges

_QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
"""Of a face with corners 0, 1, 2 and the middles 3, 4, 5 of the edges 01, 12, 20."""


@dataclass(frozen=True, eq=False)
class Subdivision:
    """A garment and its subdivision, whose first vertices are the garment's.

    Attributes:
        garment: the fine one.
        ends: of the coarse vertices in the middle of which each fine vertex lies (N, 2), both the same where it is one
            of them.
    """

    garment: Garment
    ends: np.ndarray

    shorter = 0.5
    """Its edges over the coarse ones."""

    @classmethod
    def of(cls, coarse: Garment) -> Subdivision:
        """Rest shape, skinning and attachment are interpolated; rest areas and angles stay."""
        pairs = edges(coarse.faces)
        corner_pairs = np.sort(np.stack([coarse.faces[:, [0, 1, 2]], coarse.faces[:, [1, 2, 0]]], axis=-1), axis=2)
        count = len(coarse.vertices)
        key = pairs @ [count, 1]
        middle = count + np.searchsorted(key, corner_pairs @ [count, 1])
        six = np.concatenate([coarse.faces, middle], axis=1)
        material = np.concatenate([coarse.material, 0.5 * (coarse.material + np.roll(coarse.material, -1, 1))], axis=1)
        ends = np.concatenate([np.repeat(np.arange(count), 2).reshape(-1, 2), pairs])
        between = {name: _between(getattr(coarse, name), ends) for name in ("vertices", "weights", "layer_thickness")}
        fine = replace(
            coarse,
            faces=six[:, _QUARTERS].reshape(-1, 3).astype(np.int32),
            material=material[:, _QUARTERS].reshape(-1, 3, 2),
            regions=coarse.regions[ends[:, 0]],
            attached=coarse.attached[ends].min(axis=1),  # an edge is held where both its ends are
            **between,
        )
        return cls(fine, ends)

    def carried(self, x: np.ndarray) -> np.ndarray:
        """A field (V, ...) of the coarse vertices on the fine ones (N, ...)."""
        return _between(x, self.ends)

    def seen(self, x: np.ndarray) -> np.ndarray:
        """A field (N, ...) of the fine vertices at the coarse ones (V, ...)."""
        return x[: np.count_nonzero(self.ends[:, 0] == self.ends[:, 1])]


def _between(field: np.ndarray, ends: np.ndarray) -> np.ndarray:
    return 0.5 * (field[ends[:, 0]] + field[ends[:, 1]])
