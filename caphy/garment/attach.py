"""Attachment of a garment to the body: skinning weights from the nearest body surface point, smoothed."""

from __future__ import annotations

import numpy as np

from caphy.body.model import BodyModel
from caphy.body.surface import nearest_on_surface
from caphy.conventions import JOINT_NAMES
from caphy.garment import topology
from caphy.garment.threads import neighbour_average

LIMBS = {side: [j for j, name in enumerate(JOINT_NAMES) if name.startswith(side)] for side in ("left", "right")}
NEVER = [j for j, name in enumerate(JOINT_NAMES) if j >= 22 or name == "head"]
"""Joints that carry no cloth: head, jaw, eyes and fingers."""


def skinning_weights(
    vertices: np.ndarray,
    faces: np.ndarray,
    body: BodyModel,
    body_vertices: np.ndarray,
    *,
    reach: float = 0.05,
    blend: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Weights (V, 55) of a garment on the body's rest surface.

    Each vertex takes the weights of the nearest body point of its own side (so that a trouser leg never takes the
    other leg's), these are diffused over the garment to a distance of about ``reach`` [m], and the four largest
    kept. Left and right joints are then shared across the middle, over ``blend`` (V,) [m] to each side, so that
    a skirt's front follows both legs; where ``blend`` is zero only the seam itself is shared.
    """
    near = _nearest_of_side(vertices, faces, body, body_vertices)
    near[:, NEVER] = 0.0
    near /= np.maximum(near.sum(axis=1, keepdims=True), 1e-12)
    near = _diffuse(near, vertices, faces, reach)
    return prune(_share_across_middle(near, vertices[:, 0], blend))


def _nearest_of_side(vertices: np.ndarray, faces: np.ndarray, body: BodyModel, body_vertices: np.ndarray) -> np.ndarray:
    """Interpolated body weights (V, 55) at the nearest point among the body faces on the vertex's side of x = 0."""
    centre = body_vertices[body.faces].mean(axis=1)
    cloth = body.weights[:, NEVER].sum(axis=1)[body.faces].max(axis=1) < 0.5
    weights = np.zeros((len(vertices), body.weights.shape[1]))
    for sign in (1.0, -1.0):
        mine = sign * vertices[:, 0] >= -1e-6  # vertices on the seam take the mean of both sides
        part = body.faces[cloth & (sign * centre[:, 0] >= 0)]
        hit = nearest_on_surface(vertices[mine], body_vertices, part)
        weights[mine] += np.einsum("nk,nkj->nj", hit.barycentric, body.weights[part[hit.face]])
    return weights


def _diffuse(weights: np.ndarray, vertices: np.ndarray, faces: np.ndarray, reach: float) -> np.ndarray:
    """Average with neighbours as often as it takes to spread over ``reach`` [m]: variance grows by h^2/2 a round."""
    pairs = topology.edges(faces)
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1).mean()
    average = neighbour_average(pairs, len(vertices))
    for _ in range(round(2 * (reach / length) ** 2)):
        weights = 0.5 * weights + 0.5 * (average @ weights)
    return weights


def _share_across_middle(weights: np.ndarray, x: np.ndarray, blend: np.ndarray | float) -> np.ndarray:
    """Give part of each left joint's weight to its right twin near x = 0, half of it at x = 0, and vice versa."""
    twin = np.arange(len(JOINT_NAMES))
    for j, name in enumerate(JOINT_NAMES):
        for one, other in (("left", "right"), ("right", "left")):
            if name.startswith(one):
                twin[j] = JOINT_NAMES.index(name.replace(one, other, 1))
    t = np.clip(np.abs(x) / np.maximum(blend, 1e-6), 0.0, 1.0)
    given = 0.5 * (1.0 - t * t * (3 - 2 * t))[:, None]
    return (1.0 - given) * weights + given * weights[:, twin]


def prune(weights: np.ndarray, influences: int = 4) -> np.ndarray:
    """Keep the largest ``influences`` weights of each row, of at least 1 %, and normalise."""
    weights = weights / weights.sum(axis=1, keepdims=True)
    largest = np.argsort(-weights, axis=1, kind="stable")[:, :influences]
    kept = np.zeros_like(weights)
    np.put_along_axis(kept, largest, np.take_along_axis(weights, largest, axis=1), axis=1)
    kept[kept < 0.01] = 0.0
    return kept / kept.sum(axis=1, keepdims=True)
