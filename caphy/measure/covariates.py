"""What an error may depend on: how fast, how high, how near the body, how stretched, in which pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from caphy.body.surface import Surface
from caphy.conventions import JOINT_NAMES
from caphy.io.measurements import Measurement
from caphy.io.poses import PoseSequence
from caphy.measure.local_fit import local_quadratic
from caphy.measure.prediction import Prediction

JOINT_GROUPS: Final = {
    "hips": ("left_hip", "right_hip"),
    "knees": ("left_knee", "right_knee"),
    "spine": ("spine1", "spine2", "spine3"),
    "shoulders": ("left_collar", "right_collar", "left_shoulder", "right_shoulder"),
    "elbows": ("left_elbow", "right_elbow"),
}


@dataclass(frozen=True, eq=False)
class Covariate:
    """One quantity per row and vertex (N, V), or per row (N, 1).

    ``when`` completes "the error is larger when ...", for large values.
    """

    name: str
    unit: str
    values: np.ndarray
    when: str


def covariates(prediction: Prediction, measurement: Measurement) -> list[Covariate]:
    """All that this measurement allows."""
    found = [
        Covariate("height", "m", prediction.vertices[..., 1], "the cloth is high up"),
        Covariate("stretch", "%", 100 * stretch(prediction), "the cloth is stretched"),
        *_motion_of_cloth(prediction, measurement.fps),
        *_motion_of_body(prediction, measurement),
    ]
    if prediction.body_vertices is not None:
        distance = 1e3 * _contact(prediction)
        found.append(Covariate("distance to the body", "mm", distance, "the cloth is far from the body"))
    return [c for c in found if np.isfinite(c.values).any() and np.nanstd(c.values) > 0]


def stretch(prediction: Prediction) -> np.ndarray:
    """Largest principal stretch of the model's cloth less one, mean of the faces around each vertex, (N, V).

    Read from the model: one millimetre of noise on a measured edge of two centimetres is 7 % of stretch.
    """
    material = prediction.material
    count = prediction.vertices.shape[1]
    if material is None or len(material) != len(prediction.faces):
        return np.full((1, count), np.nan)
    a, b, c = np.moveaxis(material, 1, 0)
    inverse = np.linalg.inv(np.stack([b - a, c - a], axis=-1))
    corner = prediction.vertices[:, prediction.faces]
    gradient = np.stack([corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0]], axis=-1) @ inverse
    largest = np.linalg.svd(gradient, compute_uv=False)[..., 0] - 1
    total, number = np.zeros((count, len(largest))), np.bincount(prediction.faces.ravel(), minlength=count)
    for k in range(3):
        np.add.at(total, prediction.faces[:, k], largest.T)
    return total.T / np.maximum(number, 1)


def _motion_of_cloth(prediction: Prediction, fps: float) -> list[Covariate]:
    """Read from the model too: noisy vertices would seem fast, and noise a matter of speed. Never across restarts."""
    count = prediction.vertices.shape[1]
    speed, acceleration = np.full((2, len(prediction.frames), count), np.nan)
    run = prediction.window if prediction.lag is not None else np.zeros(len(prediction.frames), int)
    for each in np.unique(run):
        rows = np.flatnonzero(run == each)
        frames = prediction.frames[rows] - prediction.frames[rows[0]]
        grid, known = np.zeros((frames[-1] + 1, count, 3)), np.zeros((frames[-1] + 1, count), bool)
        grid[frames], known[frames] = prediction.vertices[rows], True
        for row, frame in zip(rows, frames, strict=True):
            fit = local_quadratic(grid, known, fps, int(frame))
            speed[row] = np.linalg.norm(fit.velocity, axis=-1)
            acceleration[row] = np.linalg.norm(fit.acceleration, axis=-1)
    return [
        Covariate("speed", "m/s", speed, "the cloth moves fast"),
        Covariate("acceleration", "m/s²", acceleration, "the cloth accelerates"),
    ]


def _motion_of_body(prediction: Prediction, measurement: Measurement) -> list[Covariate]:
    if measurement.poses is None or measurement.transl is None or len(measurement.poses) < 2:
        return []
    motion = PoseSequence(measurement.poses, measurement.transl, measurement.fps)
    turning = np.degrees(_at_frames(motion.angular_speed()))[prediction.frames]
    walking = _at_frames(motion.linear_speed())[prediction.frames]
    angle = np.degrees(np.linalg.norm(measurement.poses, axis=-1))[prediction.frames]
    found = [
        Covariate("speed of the body", "m/s", walking[:, None], "the body moves fast"),
        Covariate("turning of the body", "°/s", turning[:, :1], "the body turns fast"),
    ]
    for group, names in JOINT_GROUPS.items():
        joints = [JOINT_NAMES.index(name) for name in names]
        found.append(
            Covariate(f"angle of the {group}", "°", angle[:, joints].max(1, keepdims=True), f"the {group} are bent")
        )
        fast = turning[:, joints].max(1, keepdims=True)
        found.append(Covariate(f"speed of the {group}", "°/s", fast, f"the {group} turn fast"))
    return found


def _at_frames(steps: np.ndarray) -> np.ndarray:
    """Mean of the steps before and after each frame."""
    return 0.5 * (np.concatenate([steps[:1], steps]) + np.concatenate([steps, steps[-1:]]))


def _contact(prediction: Prediction) -> np.ndarray:
    """Signed distance of the model's cloth to the body (N, V) [m]."""
    assert prediction.body_faces is not None and prediction.body_vertices is not None
    surface = Surface.of(prediction.body_faces, prediction.body_vertices[0])
    rows = zip(prediction.vertices, prediction.body_vertices, strict=True)
    return np.stack([surface.nearest(vertices, body).distance for vertices, body in rows])
