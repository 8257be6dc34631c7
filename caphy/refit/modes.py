"""Smooth fields on a cloth: the lowest modes of its Laplacian.

What noise and folds do to cloth is rough, what a missing effect does is mostly smooth: a residual is compared with
responses in the span of a few dozen smooth fields.
"""

from __future__ import annotations

import math

import numpy as np

from caphy.effects.cloth import Cloth
from caphy.measure.rim import Rim
from caphy.measure.windows import graph_laplacian

COUNT = 60
"""Modes in which residuals are compared; the evidence for 60 is on cloths of 300 to 1,200 vertices."""
RIM_ORDER = 7
"""Waves around a boundary loop in which it is compared where clouds end; four of them make a square's sides."""


def laplacian_modes(cloth: Cloth, count: int = COUNT) -> np.ndarray:
    """The smoothest fields on a cloth (V, count), smoothest first, each of mean square 1 over its area.

    Eigenvectors of the cotangent Laplacian (Pinkall, Polthier 1993) of the flat rest shapes with lumped areas.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import eigsh

    weight = cloth.vertex_area / cloth.vertex_area.sum()
    count = min(count, len(weight) - 2)
    start = np.random.default_rng(0).normal(size=len(weight))
    matrix, area = _stiffness(cloth), diags_array(weight)
    scale = matrix.diagonal().sum() / len(weight)
    values, vectors = eigsh(matrix / scale, count, area.tocsc(), sigma=-1e-3, v0=start)
    vectors = vectors[:, np.argsort(values)]
    return vectors * np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)])


def _stiffness(cloth: Cloth):
    """The cotangent Laplacian (V, V), positive semi-definite."""
    from scipy.sparse import coo_array

    rows, columns, entries = [], [], []
    for corner in range(3):
        a, b = (corner + 1) % 3, (corner + 2) % 3
        u, v = (cloth.material[:, k] - cloth.material[:, corner] for k in (a, b))
        cotangent = 0.5 * (u * v).sum(1) / np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
        i, j = cloth.faces[:, a], cloth.faces[:, b]
        rows += [i, j, i, j]
        columns += [j, i, i, j]
        entries += [-cotangent, -cotangent, cotangent, cotangent]
    count = len(cloth.vertices)
    where = (np.concatenate(rows), np.concatenate(columns))
    return coo_array((np.concatenate(entries), where), (count, count)).tocsc()


def rim_modes(rim: Rim, order: int = RIM_ORDER) -> np.ndarray:
    """The smoothest functions on boundary edges (E, R), on one loop each, of mean square 1 over all of the rim.

    A constant, cosines and sines of the arc length around each loop up to an order, fewer where a loop has few edges;
    R is a multiple of 3, and so is each loop's share.
    """
    found, weight = [np.zeros((len(rim.edges), 0))], rim.length / rim.length.sum()
    for loop in np.unique(rim.loop):
        on, length = rim.loop == loop, rim.length[rim.loop == loop]
        angle = 2 * np.pi * (np.cumsum(length) - length / 2) / length.sum()
        count = 3 * max(min(2 * order + 1, int(on.sum()) // 2) // 3, 1)
        waves = [np.ones_like(angle)]
        for wave in range(1, order + 1):
            waves += [np.cos(wave * angle), np.sin(wave * angle)]
        modes = np.zeros((len(on), count))
        root = np.sqrt(weight[on])[:, None]
        modes[on] = np.linalg.qr(root * np.stack(waves[:count], 1))[0] / root
        found.append(modes)
    return np.concatenate(found, axis=1)


class Projection:
    """Coefficients of fields in the modes."""

    def __init__(self, modes: np.ndarray, weight: np.ndarray, neighbours: np.ndarray) -> None:
        """``modes`` (V, M); ``weight`` (V,) areas; ``neighbours`` (E, 2) pairs."""
        self.modes, self._weight = modes, weight / weight.sum()
        self._laplacian = graph_laplacian(neighbours, len(modes))

    def of(self, fields: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Coefficients (M, ...) [as the field] of fields (V, ...) at vertices ``seen`` (V,); values elsewhere unused.

        Holes are what the harmonic continuation of the rest makes them. The same is done to residuals and responses,
        so that it hides nothing but what was not seen. Coefficients fitted to the rest alone would take what is rough
        in it for smooth: 60 modes of 81 vertices, a tenth of them missing, can be almost anything.
        """
        if not seen.any():
            return np.zeros((self.modes.shape[1], *fields.shape[1:]))
        weighted = self.modes * self._weight[:, None]
        told = weighted[seen]
        if not seen.all():
            from scipy.sparse.linalg import splu

            rows = self._laplacian[~seen]
            inner = splu(rows[:, ~seen].tocsc())
            told = told - rows[:, seen].T @ inner.solve(weighted[~seen])
        coefficients = told.T @ fields[seen].reshape(int(seen.sum()), math.prod(fields.shape[1:]))
        return coefficients.reshape(-1, *fields.shape[1:])
