"""Pose from a bad start: the body's points as an articulated mixture of Gaussians that slowly sharpens.

Every scan point is explained by all body points at once, with weights that fall off with distance and with the angle
between normals (Myronenko and Song, Coherent Point Drift, IEEE TPAMI 2010; articulated as in Horaud et al., IEEE
TPAMI 2011). While the Gaussians are wide a limb is drawn to where points are that nothing else explains, so joints may
start tens of degrees off, where nearest points would lead elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.register.articulation import POSE_UNKNOWNS, Figure, PlacedFigure, Placement
from caphy.register.cloud import Cloud, even_sample
from caphy.register.prior import PosePrior

EASE = 0.015
"""How far cloth is taken to lie off the body [m] while only the pose is sought."""
WIDTHS = np.geomspace(0.15, 0.02, 10)
"""Standard deviations of the Gaussians [m], from first to last."""
STEPS = 2
"""Gauss-Newton steps at each width."""
SCAN_POINTS, BODY_POINTS = 1200, 800
INFORMATION = 0.1
"""What a body point's pull counts for: neighbouring points err together."""
OUTLIERS = 0.02
"""Share of scan points that nothing on the body explains."""


@dataclass(frozen=True, eq=False)
class CoarseFit:
    """A pose and shape found from afar."""

    placement: Placement
    betas: np.ndarray
    """Shape (S,)."""
    misfit: float
    """Mean over scan points of the distance to their explanation [m]."""


def coarse_fit(
    figure: Figure, cloud: Cloud, start: Placement, prior: PosePrior, widths: np.ndarray = WIDTHS
) -> CoarseFit:
    """Pose and shape of ``figure`` in a cloud, from a start that may be far off."""
    cloud = cloud.thinned(SCAN_POINTS)
    targets = cloud.points - np.where(cloud.skin, 0.0, EASE)[:, None] * cloud.normals
    centres = figure.rest[0][figure.body.faces].mean(axis=1)
    face = even_sample(centres, BODY_POINTS)
    share = np.full((len(face), 3), 1 / 3)
    placement = _centred(figure, start, targets)
    misfit = np.inf
    for width in widths:
        for _ in range(STEPS):
            placed = figure.placed(placement)
            points = placed.points(face, share)
            normals = _face_normals(placed.vertices, figure.body.faces[face])
            pull, drawn, misfit = _explain(points, normals, targets, cloud.normals, width)
            step = _step(placed, face, share, points, pull, drawn, width, prior)
            placement = placement.moved(step[:POSE_UNKNOWNS], placed.world)
            figure = Figure(figure.body, figure.betas + step[POSE_UNKNOWNS:], figure.displacement)
    return CoarseFit(placement, figure.betas, misfit)


def _centred(figure: Figure, start: Placement, targets: np.ndarray) -> Placement:
    vertices = figure.placed(start).vertices
    middle = vertices[figure.body.faces[even_sample(vertices[figure.body.faces[:, 0]], BODY_POINTS)]].mean(axis=(0, 1))
    return Placement(start.rotations, start.transl + targets.mean(axis=0) - middle)


def _face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    return normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-30)


def _explain(
    points: np.ndarray, normals: np.ndarray, targets: np.ndarray, target_normals: np.ndarray, width: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """For body points (B, 3): how much scan each explains (B,), where that lies (B, 3); and the mean misfit [m]."""
    a, b = points.astype(np.float32), targets.astype(np.float32)
    square = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2 * a @ b.T
    facing = normals.astype(np.float32) @ target_normals.astype(np.float32).T
    likely = np.exp(-np.maximum(square, 0) / (2 * width * width) + 3 * (facing - 1))
    floor = OUTLIERS + 1e-12
    share = likely / (likely.sum(axis=0) + floor)
    pull = share.sum(axis=1)
    drawn = share @ b / (pull[:, None] + 1e-9)
    explained = share.sum(axis=0)
    distance = np.sqrt((share * np.maximum(square, 0)).sum(axis=0) / (explained + 1e-9))
    misfit = float((explained * distance + (1 - explained) * 3 * width).mean())
    return pull.astype(np.float64), drawn.astype(np.float64), misfit


def _step(
    placed: PlacedFigure,
    face: np.ndarray,
    share: np.ndarray,
    points: np.ndarray,
    pull: np.ndarray,
    drawn: np.ndarray,
    width: float,
    prior: PosePrior,
) -> np.ndarray:
    """The Gauss-Newton step (69 + S,) of pose, place and shape towards what body points are drawn to."""
    gap = drawn - points
    scale = np.sqrt(INFORMATION * pull) / width
    rows = np.concatenate(
        [scale[:, None] * placed.rows(face, share, np.broadcast_to(axis, points.shape), True) for axis in np.eye(3)]
    )
    value = (scale[:, None] * gap).T.ravel()
    matrix, right = rows.T @ rows, rows.T @ value
    known, slopes = prior.residuals(placed.placement, placed.world)
    pose = slice(0, POSE_UNKNOWNS)
    matrix[pose, pose] += slopes.T @ slopes
    right[pose] -= slopes.T @ known
    betas = placed.figure.betas
    shape = np.arange(POSE_UNKNOWNS, len(matrix))
    matrix[shape, shape] += 1.0
    right[shape] -= betas
    matrix[np.diag_indices(len(matrix))] += 1e-6 * np.trace(matrix) / len(matrix)
    return np.linalg.solve(matrix, right)
