"""A coarse, evenly triangulated copy of a fine body: what contact is computed against."""

from __future__ import annotations

import numpy as np

from caphy.body.surface import nearest_on_surface

EDGE_LENGTH = 0.027
"""Target edge of the coarse mesh [m]."""

_ENLARGED = {"left_wrist": 2.0, "right_wrist": 2.0, "head": 1.3}
"""Parts drawn larger while remeshing, hence triangulated finer: fingers are thinner than an edge."""

_RAMP = 0.06  # distance over which the enlargement sets in [m]


def coarse_mesh(
    vertices: np.ndarray, faces: np.ndarray, centres: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Remesh a closed body (Botsch and Kobbelt, SGP 2004) and say where each new vertex lies on the old surface.

    Args:
        vertices: (V, 3) T-pose [m].
        faces: (F, 3).
        centres: joint positions (3,) of at least the joints that are enlarged.

    Returns:
        faces (G, 3) of the coarse mesh, and per coarse vertex its fine face (U,) and barycentric weights (U, 3): any
        quantity of the fine body carries over by interpolation.
    """
    import gpytoolbox

    enlarged = _enlarged(vertices, centres)
    coarse, coarse_faces = gpytoolbox.remesh_botsch(enlarged, faces.astype(np.int32), 8, EDGE_LENGTH, True)
    nearest = nearest_on_surface(coarse, enlarged, faces)
    return coarse_faces.astype(np.int32), nearest.face, nearest.barycentric


def _enlarged(vertices: np.ndarray, centres: dict[str, np.ndarray]) -> np.ndarray:
    """Vertices with hands and head scaled up about their joints, smoothly setting in beyond the joint."""
    result = vertices.copy()
    for name, factor in _ENLARGED.items():
        centre = centres[name]
        outward = np.array([np.sign(centre[0]), 0, 0]) if "wrist" in name else np.array([0.0, 1.0, 0.0])
        beyond = (vertices - centre) @ outward
        ramp = np.clip(beyond / _RAMP, 0, 1)
        ramp = ramp * ramp * (3 - 2 * ramp)
        result += ((factor - 1) * ramp)[:, None] * (vertices - centre)
    return result
