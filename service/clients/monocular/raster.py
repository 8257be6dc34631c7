"""Triangles to points of a grid, all at once: the painter's algorithm over runs of points instead of over faces."""

from __future__ import annotations

import numpy as np

_FAR = 1e6
"""Corners are held within so many points of the grid."""


def painted(corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Which triangle covers each point of a grid, (height, width) int32; -1 where none does.

    Points have whole-numbered places. Of triangles that share an edge exactly one covers a point on it; a corner that
    lies on a point may be covered by any of its triangles. They are painted in their order, so the last one stays.

    Args:
        corners: (2, 3, F) places across and down of three corners [points of the grid], finite.
        size: width and height of the grid.
    """
    width, height = size
    face, row, begin, end = _runs(corners.clip(-_FAR, _FAR), width, height)
    counts = (end - begin).astype(np.int32)
    ends = np.cumsum(counts, dtype=np.int32)
    points = np.repeat(row * np.int32(width) + begin - (ends - counts), counts)
    points += np.arange(len(points), dtype=np.int32)
    found = np.full(width * height, -1, np.int32)
    found[points] = np.repeat(face, counts)  # of several values for one point the last is kept
    return found.reshape(height, width)


def _runs(corners: np.ndarray, width: int, height: int) -> tuple[np.ndarray, ...]:
    """Rows of points inside triangles: face, row, first and past-last column (N,) int32, in the order of faces."""
    x, y = _downwards(*corners)
    slope, base = _lines(x[[0, 0, 1]], y[[0, 0, 1]], x[[2, 1, 2]], y[[2, 1, 2]])  # the long edge, upper, lower
    rows = np.ceil(y).clip(0, height).astype(np.int32)
    counts = rows[2] - rows[0]
    face = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    row = np.repeat(rows[2] - np.cumsum(counts, dtype=np.int32), counts) + np.arange(len(face), dtype=np.int32)
    short = face + np.where(row < rows[1].take(face), 1, 2) * len(counts)
    long, short = (slope.take(edge) * row + base.take(edge) for edge in (face, short))
    begin, end = np.minimum(long, short), np.maximum(long, short)
    return face, row, *(np.ceil(columns).clip(0, width).astype(np.int32) for columns in (begin, end))


def _downwards(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3, F) each, the uppermost first."""
    x, y = x.copy(), y.copy()
    for first, second in ((0, 1), (1, 2), (0, 1)):
        swap = y[first] > y[second]
        for values in (x, y):
            values[first], values[second] = (
                np.where(swap, values[second], values[first]),
                np.where(swap, values[first], values[second]),
            )
    return x, y


def _lines(x: np.ndarray, y: np.ndarray, to_x: np.ndarray, to_y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope and base of x = slope y + base through pairs of points; level ones cross no row."""
    slope = (to_x - x) / np.where(to_y > y, to_y - y, 1.0)
    return slope, x - slope * y
