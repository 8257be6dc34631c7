"""What scanners round a person can see of surfaces, by ray casting (embreex)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import numpy as np

from caphy.report.render import embree_scene

LOOKS: Final = 40
"""Directions that a point is looked at from."""
GRAZING: Final = 0.2
"""Cosine below which a look along the surface shows nothing."""
OFF: Final = 2e-4
"""How far off its own surface a look begins [m]."""


def ray_caster(meshes: Iterable[tuple[np.ndarray, np.ndarray]]) -> Any:
    """Meshes of vertices (V, 3) [m] and faces (F, 3) together, ready for rays."""
    kept = list(meshes)
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in kept)])
    faces = np.concatenate([faces + start for (_, faces), start in zip(kept, starts, strict=False)])
    return embree_scene(np.concatenate([vertices for vertices, _ in kept]), faces)


def visible(points: np.ndarray, normals: np.ndarray, rays: Any) -> np.ndarray:
    """Which points (N,) can be seen: from one of :func:`directions`, with nothing of a :func:`ray_caster` in between.

    Args:
        points: places on a surface (N, 3) [m].
        normals: its unit normals there (N, 3), towards the side that is looked at.
    """
    seen = np.zeros(len(points), bool)
    for direction in directions():
        todo = np.flatnonzero(~seen & (normals @ direction > GRAZING))
        origins = (points[todo] + OFF * normals[todo]).astype(np.float32)
        towards = np.ascontiguousarray(np.broadcast_to(direction.astype(np.float32), origins.shape))
        seen[todo] = rays.run(origins, towards, query="OCCLUDED") != 0
    return seen


def directions() -> np.ndarray:
    """Unit vectors (LOOKS, 3) spread over the sphere, the steepest from below left out."""
    step = np.arange(LOOKS) + 0.5
    height = 1 - 1.6 * step / LOOKS
    angle = np.pi * (1 + 5**0.5) * step
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1)
