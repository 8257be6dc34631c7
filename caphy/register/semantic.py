"""The rule that ties a body to a labelled scan: skin lies on the scan, covered skin below the cloth by a margin.

Each scan point is held against the nearest point of the body's surface. ``d`` is its signed height above it [m]. A skin
point wants ``d = 0``; a cloth point wants ``d >= MARGIN``, strongly, and is drawn to ``d = MARGIN`` weakly, and less
the farther it hangs off. All are judged robustly (Geman and McClure 1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.body.surface import Surface
from caphy.register.articulation import POSE_UNKNOWNS, PlacedFigure
from caphy.register.cloud import Cloud

MARGIN = 0.004
"""How far cloth that touches lies above the skin [m]: its contact distance and half its thickness."""
DRAW, MOST_DRAWN = 0.00075, 0.03
"""Weight of a cloth point that hangs free, against one of a skin point: for each scan, and at most.

Cloth touches everywhere in some pose, and the body is just below it there. With few scans it may hang free in all."""
HANG = 0.008
"""Gap beyond the margin at which the draw of free cloth has fallen to a quarter [m]."""
FACING = 0.3
"""Least cosine between a point's normal and the body's for the two to belong together."""
NOISE = 0.002
"""Standard deviation of one point [m]."""
INFORMATION = 0.3
"""What one point counts for: its neighbours err together."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Scan points on the body: where, how far off, and how much each counts."""

    face: np.ndarray
    share: np.ndarray
    """Barycentric weights (N, 3) on ``face`` (N,)."""
    normal: np.ndarray
    """Direction (N, 3) in which the height grows."""
    height: np.ndarray
    """Signed height above the body (N,) [m]."""
    wanted: np.ndarray
    """Height to be reached (N,) [m]."""
    weight: np.ndarray
    """(N,), one for a skin point that fits, zero for what does not belong."""

    @property
    def residual(self) -> np.ndarray:
        """Height that is too much (N,) [m]."""
        return self.height - self.wanted


def match(placed: PlacedFigure, surface: Surface, cloud: Cloud, reach: float, scans: int) -> Matches:
    """Hold a cloud against a placed body.

    Args:
        reach: residual [m] at which a point counts a quarter.
        scans: how many share the body.
    """
    near = surface.nearest(cloud.points, placed.vertices)
    faces = placed.figure.body.faces
    a, b, c = (placed.vertices[faces[near.face, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    across /= np.linalg.norm(across, axis=1, keepdims=True) + 1e-30
    belongs = (across * cloud.normals).sum(axis=1) > FACING
    wanted = np.where(cloud.skin, 0.0, MARGIN)
    residual = near.distance - wanted
    free = ~cloud.skin & (residual > 0)
    scale = np.where(free, min(HANG, reach), reach)
    weight = belongs * np.where(free, min(DRAW * scans, MOST_DRAWN), 1.0) / (1 + (residual / scale) ** 2) ** 2
    return Matches(near.face, near.barycentric, near.normal, near.distance, wanted, weight)


@dataclass(frozen=True, eq=False)
class Equations:
    """Gauss-Newton equations ``matrix @ step = right`` of pose (69) and, after them, shape (S)."""

    matrix: np.ndarray
    right: np.ndarray

    def pose_step(self) -> np.ndarray:
        """The best step (69,) of the pose at a fixed shape."""
        pose = slice(0, POSE_UNKNOWNS)
        return np.linalg.solve(_damped(self.matrix[pose, pose]), self.right[pose])

    def without_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Equations of the shape alone (S, S), (S,), the pose following it (Schur complement)."""
        n = POSE_UNKNOWNS
        follow = np.linalg.solve(_damped(self.matrix[:n, :n]), np.column_stack([self.matrix[:n, n:], self.right[:n]]))
        across = self.matrix[n:, :n]
        return self.matrix[n:, n:] - across @ follow[:, :-1], self.right[n:] - across @ follow[:, -1]

    def pose_step_with(self, shape_step: np.ndarray) -> np.ndarray:
        """The best step (69,) of the pose once the shape takes ``shape_step`` (S,)."""
        n = POSE_UNKNOWNS
        return np.linalg.solve(_damped(self.matrix[:n, :n]), self.right[:n] - self.matrix[:n, n:] @ shape_step)


def equations(placed: PlacedFigure, matches: Matches, known: np.ndarray, slopes: np.ndarray, shape: bool) -> Equations:
    """Equations of what :func:`match` found and of a prior's residuals (M,) and derivatives (M, 69)."""
    used = matches.weight > 1e-4
    rows = placed.rows(matches.face[used], matches.share[used], matches.normal[used], shape)
    weighted = rows * (INFORMATION / NOISE**2 * matches.weight[used])[:, None]
    matrix, right = weighted.T @ rows, weighted.T @ matches.residual[used]
    pose = slice(0, POSE_UNKNOWNS)
    matrix[pose, pose] += slopes.T @ slopes
    right[pose] -= slopes.T @ known
    return Equations(matrix, right)


def _damped(matrix: np.ndarray) -> np.ndarray:
    return matrix + 1e-6 * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
