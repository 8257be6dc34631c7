"""Nearest points on a surface in motion, asked for again and again by cloth that moves little in between."""

from __future__ import annotations

import numpy as np

from caphy.body.surface import NearestPoints, Surface


class Following:
    """A surface that remembers its last answers, which make the next ones faster, not different."""

    def __init__(self, surface: Surface) -> None:
        self._surface = surface
        self._faces = np.zeros(0, dtype=np.int64)
        self._last: tuple[float, np.ndarray, NearestPoints] | None = None  # time, positions and answers

    def nearest(self, time: float, x: np.ndarray, vertices: np.ndarray) -> NearestPoints:
        """Nearest points for positions x (V, 3) [m] of the surface's ``vertices`` (B, 3) [m] at a time [s]."""
        if self._last is None or self._last[0] != time or len(self._last[1]) != len(x):
            guess = self._faces if len(self._faces) == len(x) else None
            found = self._surface.nearest(x, vertices, guess)
        else:
            found = self._renewed(x, vertices, *self._last[1:])
        self._faces, self._last = found.face, (time, x.copy(), found)
        return found

    def _renewed(self, x: np.ndarray, vertices: np.ndarray, before: np.ndarray, found: NearestPoints) -> NearestPoints:
        """Nearest points of positions x (V, 3) of which most are where they were; only the others are looked for."""
        moved = np.flatnonzero((x != before).any(1))
        if not len(moved):
            return found
        fields = tuple(field.copy() for field in found)
        for field, new in zip(fields, self._surface.nearest(x[moved], vertices, found.face[moved]), strict=True):
            field[moved] = new
        return NearestPoints(*fields)
