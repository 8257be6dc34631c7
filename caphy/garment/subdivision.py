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
        pairs: the ends of the edges whose middles the other vertices are (E, 2).
    """

    garment: Garment
    pairs: np.ndarray

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
        between = {name: _between(getattr(coarse, name), pairs) for name in ("vertices", "weights", "layer_thickness")}
        held = np.minimum(*coarse.attached[pairs].T)  # an edge is held where both its ends are
        fine = replace(
            coarse,
            faces=six[:, _QUARTERS].reshape(-1, 3).astype(np.int32),
            material=material[:, _QUARTERS].reshape(-1, 3, 2),
            regions=np.concatenate([coarse.regions, coarse.regions[pairs[:, 0]]]),
            attached=np.concatenate([coarse.attached, held]),
            **between,
        )
        return cls(fine, pairs)

    def carried(self, x: np.ndarray) -> np.ndarray:
        """Fine positions that lie on coarse ones (V, 3)."""
        return _between(x, self.pairs)


def _between(field: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return np.concatenate([field, 0.5 * (field[pairs[:, 0]] + field[pairs[:, 1]])])
