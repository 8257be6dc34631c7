"""Compiled loops of the multifrontal factorisation; dense blocks go through LAPACK and BLAS.

Fronts are numbered in elimination order. Front f has ``width[f]`` columns of its own, from ``first[f]`` on, among
``height[f]`` rows, all counted in vertices (3 scalars each); ``rows[start[f]:]`` are its rows in elimination order. Its
part of the factor is a column-major panel at ``panel[f]``, what it passes on a column-major square at ``update[f]``.

Routines are told addresses. What lies there must live as long as the loop: of a local array whose address alone is used
numba gives the memory away before, and whatever the routines allocate may overwrite it. ``letters`` and ``scalars``
(:func:`told`) therefore come from outside.
"""

from __future__ import annotations

import numpy as np

from caphy.jit import compiled
from caphy.solve.lapack import call

_compiled = compiled(nogil=True, error_model="numpy", boundscheck=False)

NO, TRANSPOSED, LEFT, RIGHT, LOWER = 0, 1, 2, 3, 4
_TOLD = {d: (np.array(list(b"NTLRL"), np.uint8), np.array([1.0, -1.0, 0.0], d)) for d in (np.float32, np.float64)}


def told(dtype: type) -> tuple[np.ndarray, np.ndarray]:
    """What routines of a precision are told by address, and only read: letters, and the numbers 1, -1 and 0."""
    return _TOLD[dtype]


@_compiled
def factorize(blocks, entries, fronts, children, panels, updates, letters, scalars, potrf, trsm, syrk):
    """Factorise the matrix of ``blocks`` (B, 3, 3) into ``panels``; False unless it is positive definite."""
    entry_start, entry_block, entry_row, entry_column = entries
    width, height, panel, update = fronts
    child_start, child, place_start, place = children
    item = np.uint64(panels.itemsize)
    integers = np.zeros(5, np.int32)
    letter, integer, scalar = letters.ctypes.data, integers.ctypes.data, scalars.ctypes.data
    no, turned = letter + np.uint64(NO), letter + np.uint64(TRANSPOSED)
    right, lower = letter + np.uint64(RIGHT), letter + np.uint64(LOWER)
    for f in range(len(width)):
        own, size = 3 * width[f], 3 * height[f]
        rest = size - own
        dense = panels[panel[f] : panel[f] + own * size]
        passed = updates[update[f] : update[f] + rest * rest]
        dense[:] = 0.0
        for e in range(entry_start[f], entry_start[f + 1]):
            block, row, column = entry_block[e], 3 * entry_row[e], 3 * entry_column[e]
            for q in range(3):
                for p in range(3):
                    dense[(column + q) * size + row + p] = blocks[block, p, q]
        for c in range(child_start[f], child_start[f + 1]):
            kid = child[c]
            own_kid = 3 * (height[kid] - width[kid])
            kid_update = updates[update[kid] : update[kid] + own_kid * own_kid]
            _add_to_panel(dense, own, size, kid_update, place[place_start[kid] : place_start[kid + 1]])
        integers[0], integers[1], integers[2] = own, rest, size
        at = dense.ctypes.data
        n, m, ld, info = integer, integer + np.uint64(4), integer + np.uint64(8), integer + np.uint64(12)
        call(potrf, (lower, n, at, ld, info))
        if integers[3] != 0:
            return False
        if rest > 0:
            below = at + item * np.uint64(own)
            call(trsm, (right, lower, turned, no, m, n, scalar, at, ld, below, ld))
            call(syrk, (lower, no, m, n, scalar + item, below, ld, scalar + item + item, passed.ctypes.data, m))
            for c in range(child_start[f], child_start[f + 1]):
                kid = child[c]
                own_kid = 3 * (height[kid] - width[kid])
                kid_update = updates[update[kid] : update[kid] + own_kid * own_kid]
                _add_to_square(passed, own, rest, kid_update, place[place_start[kid] : place_start[kid + 1]])
    return True


@_compiled
def _add_to_panel(dense, own, size, child, place):
    """Add the columns of a child's square that its parent eliminates."""
    count = 3 * len(place)
    for j in range(len(place)):
        if 3 * place[j] >= own:
            return
        for q in range(3):
            source, target = (3 * j + q) * count, (3 * place[j] + q) * size
            for i in range(j, len(place)):
                for p in range(3):
                    dense[target + 3 * place[i] + p] += child[source + 3 * i + p]


@_compiled
def _add_to_square(passed, own, rest, child, place):
    """Add the columns of a child's square that its parent passes on."""
    count = 3 * len(place)
    for j in range(len(place)):
        if 3 * place[j] < own:
            continue
        for q in range(3):
            source, target = (3 * j + q) * count, (3 * place[j] + q - own) * rest - own
            for i in range(j, len(place)):
                for p in range(3):
                    passed[target + 3 * place[i] + p] += child[source + 3 * i + p]


@_compiled
def solve_one(right, fronts, first, start, rows, panels, letters, scalars, trsv, gemv):
    """Replace ``right`` (3 V,), in elimination order, by the solution."""
    width, height, panel, _ = fronts
    item = np.uint64(panels.itemsize)
    integers = np.zeros(4, np.int32)
    letter, integer, scalar = letters.ctypes.data, integers.ctypes.data, scalars.ctypes.data
    no, turned, lower = letter + np.uint64(NO), letter + np.uint64(TRANSPOSED), letter + np.uint64(LOWER)
    n, m, ld, unit = integer, integer + np.uint64(4), integer + np.uint64(8), integer + np.uint64(12)
    integers[3] = 1
    one, minus = scalar, scalar + item
    work = np.empty(3 * height.max(), panels.dtype)
    for f in range(len(width)):
        own, size = 3 * width[f], 3 * height[f]
        rest = size - own
        integers[0], integers[1], integers[2] = own, rest, size
        at, mine = panels.ctypes.data + item * np.uint64(panel[f]), right.ctypes.data + item * np.uint64(3 * first[f])
        call(trsv, (lower, no, no, n, at, ld, mine, unit))
        if rest > 0:
            below = at + item * np.uint64(own)
            work[:rest] = 0  # not by BLAS: some of its versions take zero times NaN for NaN
            call(gemv, (no, m, n, minus, below, ld, mine, unit, one, work.ctypes.data, unit))
            for i in range(width[f], height[f]):
                for p in range(3):
                    right[3 * rows[start[f] + i] + p] += work[3 * i - own + p]
    for f in range(len(width) - 1, -1, -1):
        own, size = 3 * width[f], 3 * height[f]
        rest = size - own
        integers[0], integers[1], integers[2] = own, rest, size
        at, mine = panels.ctypes.data + item * np.uint64(panel[f]), right.ctypes.data + item * np.uint64(3 * first[f])
        if rest > 0:
            below = at + item * np.uint64(own)
            for i in range(width[f], height[f]):
                for p in range(3):
                    work[3 * i - own + p] = right[3 * rows[start[f] + i] + p]
            call(gemv, (turned, m, n, minus, below, ld, work.ctypes.data, unit, one, mine, unit))
        call(trsv, (lower, turned, no, n, at, ld, mine, unit))


@_compiled
def solve_many(right, fronts, first, start, rows, panels, letters, scalars, trsm, gemm):
    """Replace ``right`` (K, 3 V), in elimination order, by the solutions."""
    width, height, panel, _ = fronts
    count, total = right.shape
    item = np.uint64(panels.itemsize)
    integers = np.zeros(5, np.int32)
    letter, integer, scalar = letters.ctypes.data, integers.ctypes.data, scalars.ctypes.data
    no, turned = letter + np.uint64(NO), letter + np.uint64(TRANSPOSED)
    left, lower = letter + np.uint64(LEFT), letter + np.uint64(LOWER)
    n, m, ld = integer, integer + np.uint64(4), integer + np.uint64(8)
    k, whole = integer + np.uint64(12), integer + np.uint64(16)
    one, minus, none = scalar, scalar + item, scalar + item + item
    work = np.empty(3 * height.max() * count, panels.dtype)
    for f in range(len(width)):
        own, size = 3 * width[f], 3 * height[f]
        rest = size - own
        integers[0], integers[1], integers[2], integers[3], integers[4] = own, rest, size, count, total
        at, mine = panels.ctypes.data + item * np.uint64(panel[f]), right.ctypes.data + item * np.uint64(3 * first[f])
        call(trsm, (left, lower, no, no, n, k, one, at, ld, mine, whole))
        if rest > 0:
            below = at + item * np.uint64(own)
            call(gemm, (no, no, m, k, n, one, below, ld, mine, whole, none, work.ctypes.data, m))
            for c in range(count):
                for i in range(width[f], height[f]):
                    for p in range(3):
                        right[c, 3 * rows[start[f] + i] + p] -= work[c * rest + 3 * i - own + p]
    for f in range(len(width) - 1, -1, -1):
        own, size = 3 * width[f], 3 * height[f]
        rest = size - own
        integers[0], integers[1], integers[2], integers[3], integers[4] = own, rest, size, count, total
        at, mine = panels.ctypes.data + item * np.uint64(panel[f]), right.ctypes.data + item * np.uint64(3 * first[f])
        if rest > 0:
            below = at + item * np.uint64(own)
            for c in range(count):
                for i in range(width[f], height[f]):
                    for p in range(3):
                        work[c * rest + 3 * i - own + p] = right[c, 3 * rows[start[f] + i] + p]
            call(gemm, (turned, no, n, k, m, minus, below, ld, work.ctypes.data, m, one, mine, whole))
        call(trsm, (left, lower, turned, no, n, k, one, at, ld, mine, whole))
