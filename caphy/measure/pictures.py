"""What a comparison looks like: moving meshes for the viewer and pictures of the worst moments."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.sparse import coo_array

from caphy.errors import CaphyError
from caphy.measure.comparison import Comparison
from caphy.measure.prediction import Prediction
from caphy.measure.sentences import mm
from caphy.report.camera import Camera
from caphy.report.page.colours import error_colours, nice_ceiling
from caphy.report.page.compose import Picture, Section
from caphy.report.page.tracks import Track
from caphy.report.render import Shape, render

SIDE = 360
"""Pixels of one picture."""
RINGS = 3
"""How many edges from a vertex where something was measured others show its colour."""
_MEASURED = (0.45, 0.58, 0.72)


def section(comparison: Comparison) -> Section:
    """The part of the page about one comparison."""
    try:
        pictures = worst_moments(comparison)
    except CaphyError:  # embreex is not installed; the page does without
        pictures = ()
    return Section(comparison.figures, track(comparison), pictures)


def track(comparison: Comparison) -> Track:
    """The moving meshes of a comparison for the viewer."""
    prediction, measurement, errors = comparison.prediction, comparison.measurement, comparison.errors
    fields = {
        "distance": errors.distance,
        "outward (+) or inward": errors.normal,
        "too low (+) or too high": errors.down,
    }
    return Track(
        vertices=prediction.vertices,
        faces=prediction.faces,
        frames=prediction.frames,
        fps=measurement.fps,
        fields={name: 1e3 * _shown(comparison, values) for name, values in fields.items() if np.isfinite(values).any()},
        measured=_measured(comparison),
        body=prediction.body_vertices,
        body_faces=prediction.body_faces,
        regions=comparison.regions,
        numbering=measurement.numbering,
        moments=[moment["row"] for moment in comparison.figures["moments"]],
    )


def _shown(comparison: Comparison, values: np.ndarray) -> np.ndarray:
    """Values at vertices (T, V) as they are where the vertices themselves were measured, else :func:`_spread`."""
    prediction = comparison.prediction
    return values if prediction.registered else _spread(values, prediction.faces)


def _spread(values: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Values at vertices (T, V), NaN where nothing was measured, told there too if something was within :data:`RINGS`
    edges: of a coarser mesh, or a thin cloud, only specks would be coloured."""
    count, pairs = values.shape[1], np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    a, b = np.concatenate([pairs, pairs[:, ::-1]]).T
    joined = coo_array((np.ones(len(a)), (a, b)), (count, count)).tocsr()
    for _ in range(RINGS):
        known = np.isfinite(values)
        near = known.astype(float) @ joined
        mean = (np.where(known, values, 0.0) @ joined) / np.maximum(near, 1)
        values = np.where(known, values, np.where(near > 0, mean, np.nan))
    return values


def _measured(comparison: Comparison) -> np.ndarray | list[np.ndarray]:
    measurement, frames = comparison.measurement, comparison.prediction.frames
    if comparison.prediction.registered and measurement.vertices is not None:
        return measurement.seen_vertices[frames]
    return [measurement.cloud(int(frame)) for frame in frames]


def worst_moments(comparison: Comparison) -> tuple[Picture, ...]:
    """Model (coloured by error) and measurement side by side at the worst moments."""
    prediction = comparison.prediction
    largest = nice_ceiling(comparison.figures["error"]["p95_mm"] or 1.0)
    pictures = []
    for moment in comparison.figures["moments"]:
        row, frame = moment["row"], moment["frame"]
        model = prediction.vertices[row]
        distance = _shown(comparison, comparison.errors.distance[[row]])[0]
        colours = error_colours(1e3 * distance, largest)
        body = _body_shape(prediction, row)
        camera = Camera.framing(model, azimuth=_azimuth(comparison, row, moment["region"]), elevation=12, margin=1.2)
        images = [render([Shape(model, prediction.faces, colours), *body], camera, (SIDE, SIDE))]
        measured = _measured_shape(comparison, frame)
        if measured is not None:
            images.append(render([measured, *body], camera, (SIDE, SIDE)))
        caption = (
            f"frame {moment['number']}, {moment['time_s']:.2f} s: {moment['region'].replace('_', ' ')} "
            f"{mm(moment['median_mm'])} off"
        )
        pictures.append(Picture(_png(np.concatenate(images, axis=1)), caption, frame))
    return tuple(pictures)


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


def _body_shape(prediction: Prediction, row: int) -> list[Shape]:
    if prediction.body_vertices is None or prediction.body_faces is None:
        return []
    return [Shape(prediction.body_vertices[row], prediction.body_faces)]


def _measured_shape(comparison: Comparison, frame: int) -> Shape | None:
    """The measured surface without its holes; none for clouds, which have no surface."""
    measurement = comparison.measurement
    if measurement.vertices is None or measurement.faces is None:
        return None
    seen = measurement.observed[frame]
    faces = measurement.faces[seen[measurement.faces].all(axis=1)]
    if len(faces) == 0:
        return None
    return Shape(np.where(seen[:, None], measurement.vertices[frame], 0.0), faces, _MEASURED)


def _azimuth(comparison: Comparison, row: int, region: str) -> float:
    """From where the region is best seen: along its offset from the cloth's middle, but never edge-on from behind."""
    vertices = comparison.prediction.vertices[row]
    part = vertices[comparison.regions == region]
    outward = part.mean(axis=0) - vertices.mean(axis=0)
    if np.hypot(outward[0], outward[2]) > 0.25 * np.ptp(vertices, axis=0).max():
        return float(np.degrees(np.arctan2(outward[0], outward[2])))
    flat = vertices - vertices.mean(axis=0)
    side = np.linalg.eigh(flat[:, [0, 2]].T @ flat[:, [0, 2]])[1][:, 0]  # the thinnest level direction: seen face-on
    return float(np.degrees(np.arctan2(*(side * np.sign(side[1] or 1.0))))) + 20
