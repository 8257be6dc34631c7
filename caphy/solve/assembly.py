"""The sparse Hessian of a potential, assembled once for all effects into one fixed pattern."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from torch import Tensor

from caphy.effects.base import BodyState, Step
from caphy.effects.blocks import add_blocks
from caphy.effects.potential import Potential
from caphy.solve.factorize import Factor, Symbolic
from caphy.solve.ordering import dissect


class Hessian:
    """Assembles and factorises the second derivative of a potential.

    The matrix is kept as 3x3 blocks (B, 3, 3) [N/m]: of each pair of vertices that share an element, the one in the
    lower triangle in elimination order. Each pair of corners of each element knows its block.
    """

    def __init__(self, potential: Potential, fixed: np.ndarray | None = None) -> None:
        """``fixed`` (V,) marks vertices that do not move: their rows and columns are those of the identity."""
        self.potential = potential
        count = len(potential.cloth.vertices)
        index = {name: term.index.cpu().numpy() for name, term in potential.terms.items()}
        pattern = _pattern(list(index.values()), count)
        separators = dissect(pattern, potential.cloth.vertices)
        order = np.concatenate([separator.vertices for separator in separators])
        rank = np.argsort(order)
        pairs = coo_array(pattern)
        row, column = rank[pairs.row], rank[pairs.col]
        stored = np.sort((row * count + column)[row >= column])
        self._row, self._column = np.divmod(stored, count)
        self._slots = {name: _slots(stored, rank[corners], count) for name, corners in index.items()}
        self._diagonal = np.searchsorted(stored, rank * (count + 1))
        held = np.zeros(count, bool) if fixed is None else fixed[order]
        self._cleared = np.flatnonzero(held[self._row] | held[self._column])
        self._held = np.flatnonzero(held[self._row] & (self._row == self._column))
        self._order, self._symbolic = order, Symbolic(separators, pattern, self._row, self._column)

    def values(
        self, x: Tensor, step: Step | None = None, body: BodyState | None = None, projection: float = 1.0
    ) -> np.ndarray:
        """Blocks (B, 3, 3) [N/m] at positions (V, 3) [m].

        With ``projection`` 1 every element is positive semi-definite, with 0 all are exact, in between a mixture.
        """
        blocks = np.zeros((len(self._row), 3, 3))
        for name, term in self.potential.present(step, body):
            add_blocks(self.potential, term, x.detach(), step, body, projection, self._slots[name], blocks)
        blocks[self._cleared] = 0
        blocks[self._held] = np.eye(3)
        return blocks

    def shifted(self, blocks: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Blocks with ``shift`` (V,) [N/m] added to the diagonal."""
        moved = blocks.copy()
        moved[self._diagonal] += shift[:, None, None] * np.eye(3)
        return moved

    def factorize(self, blocks: np.ndarray, dtype: type = np.float64) -> Factor | None:
        """Cholesky factor of blocks (B, 3, 3), in a precision; None unless the matrix is positive definite."""
        return self._symbolic.factorize(blocks, dtype)

    def matrix(self, blocks: np.ndarray) -> csr_array:
        """The full symmetric matrix (3 V, 3 V) [N/m] of blocks (B, 3, 3), coordinates in vertex order."""
        row, column, size = self._order[self._row], self._order[self._column], 3 * len(self._order)
        off = row != column
        rows, columns = np.concatenate([row, column[off]]), np.concatenate([column, row[off]])
        both = np.concatenate([blocks, blocks[off].transpose(0, 2, 1)])
        axis = np.arange(3)
        place = np.broadcast_arrays(3 * rows[:, None, None] + axis[:, None], 3 * columns[:, None, None] + axis)
        return coo_array((both.ravel(), tuple(each.ravel() for each in place)), (size, size)).tocsr()


def _pattern(indices: list[np.ndarray], count: int) -> csr_array:
    """Which vertices share an element, (V, V), diagonal included."""
    pairs = [np.stack(np.broadcast_arrays(i[:, :, None], i[:, None, :]), -1).reshape(-1, 2) for i in indices if i.size]
    row, column = np.concatenate([*pairs, np.stack([np.arange(count)] * 2, 1)]).T
    pattern = coo_array((np.ones(len(row)), (row, column)), (count, count)).tocsr()
    pattern.sum_duplicates()
    return pattern


def _slots(stored: np.ndarray, corners: np.ndarray, count: int) -> np.ndarray:
    """Blocks (n, k, k) of the pairs of an element's corners (n, k), given in elimination order; -1 above."""
    row, column = np.broadcast_arrays(corners[:, :, None], corners[:, None, :])
    slots = np.searchsorted(stored, row * np.int64(count) + column)
    return np.where(row >= column, slots, -1).astype(np.int32)
