"""Convex cross sections of a body part along an axis, as support functions: what cloth stretched round it touches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

DIRECTIONS = 64


@dataclass(frozen=True)
class Sections:
    """Support heights of the slices of a body part; slice j lies at ``start + j * step`` along ``axis``."""

    origin: np.ndarray
    """A point (3,) [m] on the axis."""
    frame: np.ndarray
    """Rows (3, 3): axis and the two unit directions that span a slice."""
    start: float
    step: float
    support: np.ndarray
    """Largest extent (S, K) [m] of slice j from the axis along direction k, at angle ``2 pi k / K``."""

    @classmethod
    def of(cls, points: np.ndarray, origin: np.ndarray, axis: np.ndarray, step: float = 0.01) -> Sections:
        """Slice ``points`` (N, 3), dense samples of the part's surface, along ``axis`` (3,).

        Slices without points take the next one's; the result is smoothed along the axis over about 1.5 steps.
        """
        frame = slice_frame(axis)
        local = (points - origin) @ frame.T
        normals = circle()
        start = float(local[:, 0].min())
        index = np.rint((local[:, 0] - start) / step).astype(int)
        support = np.full((index.max() + 1, DIRECTIONS), -np.inf)
        np.maximum.at(support, index, local[:, 1:] @ normals.T)
        filled = np.flatnonzero(np.isfinite(support[:, 0]))
        nearest = np.abs(np.arange(len(support))[:, None] - filled).argmin(axis=1)
        smooth = gaussian_filter1d(support[filled[nearest]], 1.5, axis=0, mode="nearest")
        return cls(np.asarray(origin), frame, start, step, smooth)

    @property
    def stations(self) -> np.ndarray:
        """Position (S,) [m] of each slice along the axis."""
        return self.start + self.step * np.arange(len(self.support))

    def hang(self, slope: float, downstream: bool) -> Sections:
        """Let each slice be at most ``slope`` (metres per metre) narrower than its upstream neighbour.

        Cloth hangs from the widest place above it rather than following the body back in. ``downstream`` says
        whether the cloth runs with the axis or against it.
        """
        rows = self.support.copy() if downstream else self.support[::-1].copy()
        for row in range(1, len(rows)):
            rows[row] = np.maximum(rows[row], rows[row - 1] - slope * self.step)
        rows = gaussian_filter1d(rows, 1.5, axis=0, mode="nearest")
        return replace(self, support=rows if downstream else rows[::-1])

    def grown(self, ease: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Sections:
        """Add ``ease(stations (S, 1), normals (K, 3)) -> (S, K)`` [m]."""
        normals = circle() @ self.frame[1:]
        return replace(self, support=self.support + ease(self.stations[:, None], normals))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed in-slice distance (N,) [m] of points (N, 3), negative inside; end slices extend for ever."""
        local = (points - self.origin) @ self.frame.T
        place = np.clip((local[:, 0] - self.start) / self.step, 0, len(self.support) - 1.000001)
        low = place.astype(int)
        share = (place - low)[:, None]
        high = np.minimum(low + 1, len(self.support) - 1)
        result = np.empty(len(points))
        normals = circle()
        for part in np.array_split(np.arange(len(points)), max(1, len(points) // 50_000)):
            height = (1 - share[part]) * self.support[low[part]] + share[part] * self.support[high[part]]
            result[part] = (local[part, 1:] @ normals.T - height).max(axis=1)
        return result


def circle() -> np.ndarray:
    """The unit directions (K, 2) of a support function."""
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def slice_frame(axis: np.ndarray) -> np.ndarray:
    """Right-handed orthonormal rows: axis, then two directions of the slice, the second as near +z as can be."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    z = np.array([0.0, 0.0, 1.0])
    forward = z - axis * (axis @ z)
    forward /= np.linalg.norm(forward)
    return np.stack([axis, np.cross(forward, axis), forward])
