"""Sparse Cholesky factorisation of mesh Hessians: multifrontal, with the symbolic part done once per garment.

Dense fronts along a nested dissection of the mesh go through LAPACK (Duff and Reid, ACM TOMS 9, 1983; Liu, SIAM
Review 34, 1992).
"""

from __future__ import annotations

import weakref
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_array

from caphy.solve import factor_kernels
from caphy.solve.factor_kernels import told
from caphy.solve.lapack import GEMM, GEMV, POTRF, SYRK, TRSM, TRSV
from caphy.solve.ordering import Separator


class Symbolic:
    """What the factorisations of matrices of one sparsity pattern share.

    Attributes:
        order: vertices in elimination order, (V,).
    """

    def __init__(self, separators: list[Separator], pattern: csr_array, row: np.ndarray, column: np.ndarray) -> None:
        """``row >= column`` (B,) are the places of the stored 3x3 blocks in elimination order."""
        self.order = np.concatenate([separator.vertices for separator in separators])
        rank = np.argsort(self.order)
        width = np.array([len(separator.vertices) for separator in separators])
        stop = np.cumsum(width)
        self._first = stop - width
        later = _later(separators, pattern, rank, stop)
        rows = [np.concatenate([np.arange(a, b), r]) for a, b, r in zip(self._first, stop, later, strict=True)]
        height = np.array([len(each) for each in rows])
        self._start, self._rows = _starts(rows), np.concatenate(rows)
        panel = np.concatenate([[0], np.cumsum(9 * width * height)])
        update, passed = _stacked(separators, 9 * (height - width) ** 2)
        self._fronts = (width, height, panel[:-1], update)
        columns = [np.arange(3 * own) for own in width]
        self._pivots = np.concatenate(
            [at + each * (3 * high + 1) for at, each, high in zip(panel, columns, height, strict=False)]
        )
        self._entries = _entries(rows, np.searchsorted(stop, column, side="right"), row, column)
        self._children = _children(separators, rows, later)
        self._updates = {dtype: np.empty(passed, dtype) for dtype in POTRF}
        self._size, self._spare = int(panel[-1]), {dtype: [] for dtype in POTRF}

    def factorize(self, blocks: np.ndarray, dtype: type = np.float64) -> Factor | None:
        """The Cholesky factor of the matrix of ``blocks`` (B, 3, 3); None unless it is positive definite, which it is
        not with an entry that is no number.

        ``dtype`` is the precision to work in: numpy.float32 takes about half the time.
        """
        spare = self._spare[dtype]
        panels = spare.pop() if spare else np.empty(self._size, dtype)
        given = (blocks, self._entries, self._fronts, self._children, panels, self._updates[dtype], *told(dtype))
        done = factor_kernels.factorize(*given, POTRF[dtype], TRSM[dtype], SYRK[dtype])
        if done and np.isfinite(panels[self._pivots]).all():  # to some versions of LAPACK NaN is as good as any
            return Factor(self, panels)
        spare.append(panels)
        return None


class Factor:
    """A Cholesky factor; solves for as many right-hand sides as wanted."""

    def __init__(self, symbolic: Symbolic, panels: np.ndarray) -> None:
        self._symbolic, self._panels = symbolic, panels
        weakref.finalize(self, symbolic._spare[panels.dtype.type].append, panels)  # used again: saves clearing memory

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solutions of H s = right for vertex fields ``right`` (V, 3) or (V, 3, K) with K columns."""
        s, dtype = self._symbolic, self._panels.dtype.type
        if right.size == 0:
            return np.zeros(right.shape)
        columns = right.reshape(*right.shape[:2], -1)[s.order].transpose(2, 0, 1)
        columns = np.array(columns, dtype=dtype, order="C").reshape(len(columns), -1)
        where = (s._fronts, s._first, s._start, s._rows, self._panels, *told(dtype))
        if len(columns) == 1:
            factor_kernels.solve_one(columns[0], *where, TRSV[dtype], GEMV[dtype])
        else:
            factor_kernels.solve_many(columns, *where, TRSM[dtype], GEMM[dtype])
        solution = np.empty((*right.shape[:2], len(columns)))
        solution[s.order] = columns.reshape(len(columns), -1, 3).transpose(1, 2, 0)
        return solution.reshape(right.shape)


def _later(separators: list[Separator], pattern: csr_array, rank: np.ndarray, stop: np.ndarray) -> list[np.ndarray]:
    """Vertices, in elimination order, that each front still updates."""
    later: list[np.ndarray] = []
    for separator, end in zip(separators, stop, strict=True):
        neighbours = rank[pattern[separator.vertices].indices]
        reached = np.unique(np.concatenate([neighbours, *(later[child] for child in separator.children)]))
        later.append(reached[reached >= end])
    return later


def _starts(lists: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum([len(each) for each in lists])])


def _entries(rows: list[np.ndarray], owner: np.ndarray, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, ...]:
    """Where each front's own entries start, and of each entry its block, row and column in the front."""
    inside = np.argsort(owner, kind="stable")
    start = np.searchsorted(owner[inside], np.arange(len(rows) + 1))
    parts = [inside[a:b] for a, b in pairwise(start)]
    places = [
        np.concatenate([np.searchsorted(r, which[part]) for r, part in zip(rows, parts, strict=True)])
        for which in (row, column)
    ]
    return start, inside, *places


def _children(separators: list[Separator], rows: list[np.ndarray], later: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Where each front's children start, the children, and for each front where its later rows lie in its parent."""
    children = [np.array(separator.children, dtype=np.int64) for separator in separators]
    places = [np.zeros(0, dtype=np.int64)] * len(rows)
    for front, below in zip(rows, children, strict=True):
        for child in below:
            places[child] = np.searchsorted(front, later[child])
    return _starts(children), np.concatenate(children), _starts(places), np.concatenate(places)


def _stacked(separators: list[Separator], sizes: np.ndarray) -> tuple[np.ndarray, int]:
    """Offsets of what fronts pass on, and the room it takes.

    It waits on two stacks, of the tree's even and odd depths: those of a front's children are on top of one when the
    front is eliminated, and its own goes on top of the other.
    """
    depth = np.zeros(len(separators), dtype=np.int64)
    for place in range(len(separators) - 1, -1, -1):
        depth[list(separators[place].children)] = depth[place] + 1
    offset, top, most = np.zeros(len(separators), dtype=np.int64), [0, 0], [0, 0]
    for place, separator in enumerate(separators):
        even = depth[place] % 2
        offset[place] = top[even]
        top[even] += sizes[place]
        most[even] = max(most[even], top[even])
        top[1 - even] -= sizes[list(separator.children)].sum()
    offset[depth % 2 == 1] += most[0]
    return offset, int(sum(most))
