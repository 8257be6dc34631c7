"""A pinhole camera that frames what it is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """Where the eye is, what it looks at, and how wide it sees. World axes: y up, metres."""

    eye: np.ndarray
    """Position (3,) [m]."""
    target: np.ndarray
    """Point in the middle of the picture (3,) [m]."""
    field_of_view: float = 25.0
    """Full angle across the picture's shorter side [degrees]."""

    @classmethod
    def framing(
        cls,
        points: np.ndarray,
        azimuth: float = 0.0,
        elevation: float = 5.0,
        *,
        aspect: float = 1.0,
        field_of_view: float = 25.0,
        margin: float = 1.06,
    ) -> Camera:
        """A camera that just holds ``points`` (N, 3).

        Args:
            azimuth: direction of the eye [degrees]: 0 in front of a body facing +z, 90 on its left (+x), 180 behind.
            elevation: height of the eye above the horizon [degrees].
            aspect: width over height of the picture.
            margin: how much larger than the points the view is.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        a, e = np.radians(azimuth), np.radians(elevation)
        outward = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        right, up, _ = cls(centre + outward, centre).axes()
        half = np.tan(np.radians(field_of_view) / 2)
        offset = points - centre
        slope_x, slope_y = half * max(aspect, 1.0), half * max(1 / aspect, 1.0)
        reach = np.maximum(np.abs(offset @ right) / slope_x, np.abs(offset @ up) / slope_y)
        distance = float(np.max(reach * margin + offset @ outward))
        return cls(centre + max(distance, 1e-3) * outward, centre, field_of_view)

    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit vectors right, up and forward, (3,) each."""
        forward = _unit(np.asarray(self.target, dtype=np.float64) - self.eye)
        up = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.999 else np.array([0.0, 0.0, -1.0])
        right = _unit(np.cross(forward, up))
        return right, np.cross(right, forward), forward

    def rays(self, width: int, height: int) -> np.ndarray:
        """Unit directions (height * width, 3) through the pixel centres, row by row from the top left."""
        right, up, forward = self.axes()
        half = np.tan(np.radians(self.field_of_view) / 2) / min(width, height)
        x = (2 * np.arange(width) + 1 - width) * half
        y = (height - 1 - 2 * np.arange(height)) * half
        directions = forward + x[None, :, None] * right + y[:, None, None] * up
        directions = directions.reshape(-1, 3)
        return directions / np.sqrt(np.einsum("nc,nc->n", directions, directions))[:, None]


def _unit(vector: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.asarray(vector) / np.linalg.norm(vector)
