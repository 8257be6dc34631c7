"""The sparse Hessian of a potential, assembled once for all effects into one fixed pattern."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array, csr_array
from torch import Tensor

from caphy.effects.base import BodyState, Elements, Step
from caphy.effects.potential import Potential, Term
from caphy.solve.factorize import Factor, Symbolic
from caphy.solve.ordering import dissect


class Hessian:
    """Assembles and factorises the second derivative of a potential.

    Each entry of each element Hessian knows its slot among the stored entries (the lower triangle in elimination
    order), so that assembly is one weighted count per effect.
    """

    def __init__(self, potential: Potential, fixed: np.ndarray | None = None) -> None:
        """``fixed`` (V,) marks vertices that do not move: their rows and columns are those of the identity."""
        self.potential = potential
        count = len(potential.cloth.vertices)
        pattern = _pattern([term.index.cpu().numpy() for term in potential.terms.values()], count)
        separators = dissect(pattern, potential.cloth.vertices)
        rank = np.argsort(np.concatenate([separator.vertices for separator in separators]))
        keys, diagonal = {}, 3 * count
        for name, term in potential.terms.items():
            keys[name] = _keys(term.index.cpu().numpy(), rank)
        own = np.arange(diagonal, dtype=np.int64) * (diagonal + 1)
        stored = np.unique(np.concatenate([own, *(key[key >= 0] for key in keys.values())]))
        row, column = np.divmod(stored, diagonal)
        self._size = len(stored)
        self._slots = {name: np.where(key < 0, self._size, np.searchsorted(stored, key)) for name, key in keys.items()}
        self._diagonal = np.searchsorted(stored, own).reshape(-1, 3)[rank]
        held = np.zeros(count, bool) if fixed is None else fixed
        held = np.repeat(held[np.argsort(rank)], 3)
        self._cleared = np.flatnonzero(held[row] | held[column])
        self._held = np.flatnonzero(held[row] & (row == column))
        self._symbolic = Symbolic(separators, pattern, row, column)
        self._row, self._column, self._scalar_rank = row, column, _scalar_rank(rank)

    def values(
        self, x: Tensor, step: Step | None = None, body: BodyState | None = None, projection: float = 1.0
    ) -> np.ndarray:
        """Stored entries (N,) [N/m] at positions (V, 3) [m].

        With ``projection`` 1 every element is positive semi-definite, with 0 all are exact. In between faces, whose
        compression is what makes a Hessian indefinite, are mixed and the rest is projected.
        """
        values = np.zeros(self._size + 1)
        for name, term, elements in self.potential.acting(x, step, body):
            blocks = _element_hessian(term, elements, projection).to(torch.float64).contiguous().cpu().numpy()
            values += np.bincount(self._slots[name], blocks.reshape(-1), self._size + 1)
        values = values[:-1]
        values[self._cleared] = 0
        values[self._held] = 1
        return values

    def shifted(self, values: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Entries with ``shift`` (V,) [N/m] added to the diagonal."""
        moved = values.copy()
        moved[self._diagonal] += shift[:, None]
        return moved

    def factorize(self, values: np.ndarray) -> Factor | None:
        """Cholesky factor of stored entries (N,); None unless the matrix is positive definite."""
        return self._symbolic.factorize(values)

    def matrix(self, values: np.ndarray) -> csr_array:
        """The full symmetric matrix (3 V, 3 V) [N/m] of stored entries (N,), coordinates in vertex order."""
        natural = np.argsort(self._scalar_rank)
        row, column = natural[self._row], natural[self._column]
        size = len(natural)
        below = coo_array((values, (row, column)), (size, size)).tocsr()
        off = self._row != self._column
        return below + coo_array((values[off], (column[off], row[off])), (size, size)).tocsr()


def _element_hessian(term: Term, elements: Elements, projection: float) -> Tensor:
    """Element Hessians (k, 3, k, 3, n) [N/m], projected as :meth:`Hessian.values` says."""
    if projection == 0:
        return term.effect.hessian(elements, term.values)
    projected = term.effect.projected_hessian(elements, term.values)
    if projection == 1 or term.effect.element != "face":
        return projected
    return torch.lerp(term.effect.hessian(elements, term.values), projected, projection)


def _pattern(indices: list[np.ndarray], count: int) -> csr_array:
    """Which vertices share an element, (V, V), diagonal included."""
    pairs = [np.stack(np.broadcast_arrays(i[:, :, None], i[:, None, :]), -1).reshape(-1, 2) for i in indices if i.size]
    row, column = np.concatenate([*pairs, np.stack([np.arange(count)] * 2, 1)]).T
    pattern = coo_array((np.ones(len(row)), (row, column)), (count, count)).tocsr()
    pattern.sum_duplicates()
    return pattern


def _scalar_rank(rank: np.ndarray) -> np.ndarray:
    return (3 * rank[:, None] + np.arange(3)).reshape(-1)


def _keys(index: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """row * 3V + column in elimination order of each entry of element Hessians (k, 3, k, 3, n); -1 above."""
    place = 3 * rank[index].T[:, None, :] + np.arange(3)[None, :, None]  # (k, 3, n)
    row, column = place[:, :, None, None, :], place[None, None, :, :, :]
    key = row * np.int64(3 * len(rank)) + column
    return np.where(row >= column, key, -1).reshape(-1)
