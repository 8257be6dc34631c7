"""Sparse Cholesky factorisation of mesh Hessians: multifrontal, with the symbolic part done once per garment.

Dense fronts along a nested dissection of the mesh go through LAPACK (Duff and Reid, ACM TOMS 9, 1983; Liu, SIAM
Review 34, 1992). At 2,000 vertices and one thread a factorisation takes 18 ms, where SuperLU takes 77 ms, CHOLMOD (by
way of cholespy, which repeats its analysis) 99 ms and QDLDL 117 ms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs
from scipy.sparse import csr_array

from caphy.solve.ordering import Separator

dsyrk, dtrsm = get_blas_funcs(("syrk", "trsm"), dtype=np.float64)
(dpotrf,) = get_lapack_funcs(("potrf",), dtype=np.float64)


@dataclass(frozen=True)
class _Front:
    """A dense block: the columns of one separator and the later rows they touch."""

    columns: slice
    rows: np.ndarray
    """Scalar rows of the front in elimination order, its own columns first, (n,)."""
    source: np.ndarray
    """Matrix entries that enter here ..."""
    target: np.ndarray
    """... and their places in the front's column-major storage."""
    children: tuple[tuple[int, np.ndarray], ...]
    """Child fronts and the places of their remaining rows in this front."""


class Symbolic:
    """What the factorisations of matrices of one sparsity pattern share."""

    def __init__(self, separators: list[Separator], pattern: csr_array, row: np.ndarray, column: np.ndarray) -> None:
        """``row >= column`` (N,) are the scalar positions of the stored entries in elimination order."""
        self.order = np.concatenate([separator.vertices for separator in separators])
        rank = np.argsort(self.order)
        self._fronts = _fronts(separators, pattern, rank, row, column)
        largest = max(len(front.rows) for front in self._fronts)
        self._workspace = np.empty(largest * largest)
        self._scalars = _scalars(self.order)

    def factorize(self, values: np.ndarray) -> Factor | None:
        """The Cholesky factor of the matrix with entries ``values`` (N,); None unless it is positive definite."""
        blocks, updates = [], {}
        for place, front in enumerate(self._fronts):
            size, width = len(front.rows), front.columns.stop - front.columns.start
            flat = self._workspace[: size * size]
            flat[:] = 0
            flat[front.target] = values[front.source]
            dense = flat.reshape(size, size, order="F")
            for child, rows in front.children:
                _extend_add(dense, updates.pop(child), rows)
            diagonal, failed = dpotrf(dense[:width, :width], lower=1, clean=0)
            if failed:
                return None
            below = None
            if size > width:
                below = dtrsm(1.0, diagonal, dense[width:, :width], side=1, lower=1, trans_a=1)
                updates[place] = dsyrk(-1.0, below, beta=1.0, c=dense[width:, width:], lower=1)
            else:
                updates[place] = np.empty((0, 0), order="F")
            blocks.append((diagonal, below))
        return Factor(self, blocks)


class Factor:
    """A Cholesky factor; solves for as many right-hand sides as wanted."""

    def __init__(self, symbolic: Symbolic, blocks: list[tuple[np.ndarray, np.ndarray | None]]) -> None:
        self._symbolic, self._blocks = symbolic, blocks

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solutions of H s = right for vertex fields ``right`` (V, 3) or (V, 3, K) with K columns."""
        fronts, scalars = self._symbolic._fronts, self._symbolic._scalars
        flat = right.reshape(len(scalars), -1)
        s = flat[scalars]
        for front, (diagonal, below) in zip(fronts, self._blocks, strict=True):
            s[front.columns] = dtrsm(1.0, diagonal, s[front.columns], lower=1)
            if below is not None:
                s[front.rows[diagonal.shape[0] :]] -= below @ s[front.columns]
        for front, (diagonal, below) in zip(reversed(fronts), reversed(self._blocks), strict=True):
            own = s[front.columns]
            if below is not None:
                own = own - below.T @ s[front.rows[diagonal.shape[0] :]]
            s[front.columns] = dtrsm(1.0, diagonal, own, lower=1, trans_a=1)
        solution = np.empty_like(s)
        solution[scalars] = s
        return solution.reshape(right.shape)


def _scalars(vertices: np.ndarray) -> np.ndarray:
    """Indices of the three coordinates of vertices (n,), (3 n,)."""
    return (3 * vertices[:, None] + np.arange(3)).reshape(-1)


def _fronts(
    separators: list[Separator], pattern: csr_array, rank: np.ndarray, row: np.ndarray, column: np.ndarray
) -> list[_Front]:
    stops = np.cumsum([len(separator.vertices) for separator in separators])
    starts = stops - [len(separator.vertices) for separator in separators]
    owner = np.searchsorted(3 * stops, column, side="right")
    entries = np.split(np.argsort(owner, kind="stable"), np.searchsorted(np.sort(owner), np.arange(1, len(stops))))
    later: list[np.ndarray] = []  # vertices, in elimination order, that each front still updates
    fronts = []
    for separator, start, stop, inside in zip(separators, starts, stops, entries, strict=True):
        neighbours = rank[pattern[separator.vertices].indices]
        reached = np.unique(np.concatenate([neighbours, *(later[child] for child in separator.children)]))
        later.append(reached[reached >= stop])
        rows = _scalars(np.concatenate([np.arange(start, stop), later[-1]]))
        target = np.searchsorted(rows, row[inside]) + len(rows) * np.searchsorted(rows, column[inside])
        children = tuple((child, np.searchsorted(rows, _scalars(later[child]))) for child in separator.children)
        fronts.append(_Front(slice(3 * start, 3 * stop), rows, inside, target, children))
    return fronts


@numba.njit(cache=True)
def _extend_add(dense: np.ndarray, update: np.ndarray, rows: np.ndarray) -> None:
    """Add the lower triangle of a child's update into its parent's front."""
    for j in range(len(rows)):
        for i in range(j, len(rows)):
            dense[rows[i], rows[j]] += update[i, j]
