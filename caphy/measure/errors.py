"""Errors of vertices and of surfaces, and their parts along and across the cloth. All robust to holes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import KDTree

from caphy.body.surface import Surface
from caphy.io.measurements import Measurement
from caphy.measure.prediction import Prediction
from caphy.report.render import vertex_normals

DOWN: Final = np.array([0.0, -1.0, 0.0])
MOST = 5000
"""Points of a cloud that are looked at; more tell little more of a frame, and cost as much again."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Model minus measurement at each vertex, or of each measured point, of each row; NaN where nothing was measured.

    Attributes:
        distance: (N, P) [m].
        normal: signed, outward positive: the model lies outside of the measured cloth, (N, P) [m].
        along: length of the part within the cloth's surface, (N, P) [m]; NaN of clouds.
        down: signed, positive where the model is too low, (N, P) [m]; NaN of clouds.
        vertex: which of the model's vertices each stands for, (N, P).
    """

    distance: np.ndarray
    normal: np.ndarray
    along: np.ndarray
    down: np.ndarray
    vertex: np.ndarray

    @classmethod
    def across(cls, signed: np.ndarray, vertex: np.ndarray) -> Errors:
        """Of distances to the surface (N, P) [m] with the signs of :class:`SurfaceErrors`; no more is known of them."""
        unknown = np.full_like(signed, np.nan)
        return cls(np.abs(signed), -signed, unknown, unknown, vertex)


def vertex_errors(prediction: Prediction, measurement: Measurement) -> Errors:
    """Errors of a registered prediction. Normals are the model's, which has neither noise nor holes."""
    assert measurement.vertices is not None
    seen = measurement.observed[prediction.frames]
    offset = np.where(seen[..., None], prediction.vertices - measurement.vertices[prediction.frames], np.nan)
    normals = np.stack([vertex_normals(x, prediction.faces) for x in prediction.vertices])
    normal = (offset * normals).sum(-1)
    along = np.linalg.norm(offset - normal[..., None] * normals, axis=-1)
    distance = np.linalg.norm(offset, axis=-1)
    return Errors(distance, normal, along, offset @ DOWN, _every_vertex(distance))


def _every_vertex(field: np.ndarray) -> np.ndarray:
    """The vertex of each entry of a field (N, V)."""
    return np.broadcast_to(np.arange(field.shape[1]), field.shape)


@dataclass(frozen=True, eq=False)
class SurfaceErrors:
    """Distances between the measured points and the model's surface.

    Attributes:
        signed: row by row, from each measured point to the model's surface, positive where the measured cloth lies on
            the outer side of the model, (n,) [m] each.
        owner: row by row, the model vertex nearest to each measured point, (n,) each.
        reverse: row by row, from each model vertex to the measured points, (V,) [m] each.
        vertex: ``signed`` gathered at the owners: mean, (N, V) [m]; NaN where none is. Noise averages away in it, the
            more so the denser the cloud: it is there to be looked at.
    """

    signed: list[np.ndarray]
    owner: list[np.ndarray]
    reverse: list[np.ndarray]
    vertex: np.ndarray

    @property
    def of_points(self) -> Errors:
        """Errors of the points themselves (N, P), P being those of the longest row."""
        longest = max(map(len, self.signed))
        signed, owner = np.full((len(self.signed), longest), np.nan), np.zeros((len(self.signed), longest), int)
        for row, (distance, vertex) in enumerate(zip(self.signed, self.owner, strict=True)):
            signed[row, : len(distance)], owner[row, : len(distance)] = distance, vertex
        return Errors.across(signed, owner)

    @property
    def of_vertices(self) -> Errors:
        """Means of the points at each vertex (N, V)."""
        return Errors.across(self.vertex, _every_vertex(self.vertex))

    @property
    def chamfer(self) -> np.ndarray:
        """Chamfer distance of each row (N,) [m].

        Half the sum of the mean distance from measured points to the model's surface and the mean distance from model
        vertices to the nearest measured point (not squared). The second part cannot fall below the points' spacing.
        """
        return np.array([0.5 * (np.abs(s).mean() + r.mean()) for s, r in zip(self.signed, self.reverse, strict=True)])


def picked(cloud: np.ndarray) -> np.ndarray:
    """Those of a cloud's points, or of what belongs to them (n, ...), that are looked at: :data:`MOST`, evenly."""
    return cloud if len(cloud) <= MOST else cloud[np.linspace(0, len(cloud) - 1, MOST).astype(int)]


def surface_errors(prediction: Prediction, measurement: Measurement) -> SurfaceErrors:
    """Distances of the measured points of each row, whether registered or not.

    Of a registered measurement only the vertices that were seen count in the reverse direction; of a cloud of more than
    :data:`MOST` points as many, evenly picked, in the other.
    """
    surface = Surface.of(prediction.faces, prediction.vertices[0])
    signed, owners, reverse, at_vertices = [], [], [], np.full(prediction.vertices.shape[:2], np.nan)
    for row, (frame, model) in enumerate(zip(prediction.frames, prediction.vertices, strict=True)):
        cloud = measurement.cloud(int(frame))
        if len(cloud) == 0:
            signed.append(np.full(1, np.nan))
            owners.append(np.zeros(1, int))
            reverse.append(np.full(1, np.nan))
            continue
        counted = model[measurement.observed[frame]] if prediction.registered else model
        reverse.append(KDTree(cloud).query(counted)[0])
        if not prediction.registered:
            cloud = picked(cloud)
        distance, owner = surface.nearest(cloud, model).distance, KDTree(model).query(cloud)[1]
        signed.append(distance)
        owners.append(owner)
        count = np.bincount(owner, minlength=len(model))
        total = np.bincount(owner, distance, len(model))
        at_vertices[row] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return SurfaceErrors(signed, owners, reverse, at_vertices)
