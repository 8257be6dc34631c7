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


@dataclass(frozen=True, eq=False)
class VertexErrors:
    """Model minus measurement at each vertex of each row; NaN where nothing was measured.

    Attributes:
        distance: (N, V) [m].
        normal: signed, outward positive: the model lies outside of the measured cloth, (N, V) [m].
        along: length of the part within the cloth's surface, (N, V) [m].
        down: signed, positive where the model is too low, (N, V) [m].
    """

    distance: np.ndarray
    normal: np.ndarray
    along: np.ndarray
    down: np.ndarray


def vertex_errors(prediction: Prediction, measurement: Measurement) -> VertexErrors:
    """Errors of a registered prediction. Normals are the model's, which has neither noise nor holes."""
    assert measurement.vertices is not None
    seen = measurement.observed[prediction.frames]
    offset = np.where(seen[..., None], prediction.vertices - measurement.vertices[prediction.frames], np.nan)
    normals = np.stack([vertex_normals(x, prediction.faces) for x in prediction.vertices])
    normal = (offset * normals).sum(-1)
    along = np.linalg.norm(offset - normal[..., None] * normals, axis=-1)
    return VertexErrors(np.linalg.norm(offset, axis=-1), normal, along, offset @ DOWN)


@dataclass(frozen=True, eq=False)
class SurfaceErrors:
    """Distances between the measured points and the model's surface.

    Attributes:
        signed: row by row, from each measured point to the model's surface, positive where the measured cloth lies on
            the outer side of the model, (n,) [m] each.
        reverse: row by row, from each model vertex to the measured points, (V,) [m] each.
        vertex: ``signed`` gathered at the model vertex nearest to each point: mean, (N, V) [m]; NaN where none is.
    """

    signed: list[np.ndarray]
    reverse: list[np.ndarray]
    vertex: np.ndarray

    @property
    def chamfer(self) -> np.ndarray:
        """Chamfer distance of each row (N,) [m].

        Half the sum of the mean distance from measured points to the model's surface and the mean distance from model
        vertices to the nearest measured point (not squared). The second part cannot fall below the points' spacing.
        """
        return np.array([0.5 * (np.abs(s).mean() + r.mean()) for s, r in zip(self.signed, self.reverse, strict=True)])


def surface_errors(prediction: Prediction, measurement: Measurement) -> SurfaceErrors:
    """Distances of the measured points of each row, whether registered or not.

    Of a registered measurement only the vertices that were seen count in the reverse direction.
    """
    surface = Surface.of(prediction.faces, prediction.vertices[0])
    signed, reverse, at_vertices = [], [], np.full(prediction.vertices.shape[:2], np.nan)
    for row, (frame, model) in enumerate(zip(prediction.frames, prediction.vertices, strict=True)):
        cloud = measurement.cloud(int(frame))
        if len(cloud) == 0:
            signed.append(np.full(1, np.nan))
            reverse.append(np.full(1, np.nan))
            continue
        distance = surface.nearest(cloud, model).distance
        signed.append(distance)
        counted = model[measurement.observed[frame]] if prediction.registered else model
        reverse.append(KDTree(cloud).query(counted)[0])
        owner = KDTree(model).query(cloud)[1]
        count = np.bincount(owner, minlength=len(model))
        total = np.bincount(owner, distance, len(model))
        at_vertices[row] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return SurfaceErrors(signed, reverse, at_vertices)
