"""The cut of a garment: an implicit surface round the body and the curves that end it. See ``families``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from caphy.body.surface import Surface
from caphy.garment.landmarks import Landmarks
from caphy.garment.meshing import Field


@dataclass(frozen=True)
class Cut:
    """A garment, symmetric in x, described without a mesh."""

    surface: Field
    """Negative inside; the cloth is its zero set."""
    openings: Mapping[str, Field]
    """Where the cloth ends: it is kept where every field is positive."""
    low: np.ndarray
    """Corners (3,) [m] of the box that holds the half."""
    high: np.ndarray


def folded(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) with the right half (x < 0) laid onto the left."""
    return np.column_stack([np.abs(points[:, 0]), points[:, 1:]])


def smooth_min(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Minimum with its crease rounded over about ``radius`` [m] (union of two shapes with a fillet)."""
    h = np.maximum(radius - np.abs(a - b), 0.0) / radius
    return np.minimum(a, b) - 0.25 * radius * h * h


def smooth_max(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Maximum with its crease rounded over about ``radius`` [m] (intersection with a fillet)."""
    return -smooth_min(-a, -b, radius)


def smooth_step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def body_distance(marks: Landmarks) -> Field:
    """Signed distance (N,) [m] to the body or its mirror image, whichever is nearer; negative inside."""
    surface = Surface.of(marks.body.faces, marks.vertices)

    def field(points: np.ndarray) -> np.ndarray:
        sides = (surface.nearest(p, marks.vertices).distance for p in (points, points * [-1.0, 1.0, 1.0]))
        return np.minimum(*sides)

    return field
