"""Results of TRAM (Wang et al., ECCV 2024): ``hps/hps_track_K.npy``, one file for each person.

One dictionary of tensors: pred_rotmat (T, 24, 3, 3), pred_trans (T, 1, 3) [m] in the camera's axes, pred_shape
(T, 10), frame (T,). ``camera.npy`` in the folder above, where it is, tells how the camera moved: pred_cam_R (F, 3, 3)
and pred_cam_T (F, 3) carry points into the first camera's axes. SMPL's 24 joints.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.io.pickles import read_boxed
from caphy.io.poses.camera import level_camera
from caphy.io.poses.estimated import estimated
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.smpl import axis_angles, poses_from_columns, require_fps, rest_pelvis
from caphy.rotations import matrix_from_axis_angle


def read_tram(path: Path, fps: float | None) -> PoseSequence:
    """The motion of one track; ``fps`` [Hz] is the video's and must be given. Raises :class:`CaphyError`."""
    results = read_boxed(path)
    rotations = _numbers(results, "pred_rotmat", (24, 3, 3), path)
    count = len(rotations)
    fps = require_fps(fps, str(path), "TRAM does not keep the video's frame rate")
    transl = _numbers(results, "pred_trans", (1, 3), path, count)[:, 0]
    numbers = _numbers(results, "frame", (), path, count).astype(int)
    betas = _numbers(results, "pred_shape", (10,), path, count)
    columns = axis_angles(rotations, f"{path}: pred_rotmat").reshape(count, 72)
    poses, model, notes = poses_from_columns(columns, str(path))
    pelvis, _ = rest_pelvis(model, "neutral", None)
    poses, transl, moved = _in_first_camera(poses, transl, np.asarray(pelvis), numbers, path)
    return level_camera(estimated(path, fps, poses, transl, numbers, betas, model, (*notes, moved)))


def _in_first_camera(
    poses: np.ndarray, transl: np.ndarray, pelvis: np.ndarray, numbers: np.ndarray, path: Path
) -> tuple[np.ndarray, np.ndarray, str]:
    """The motion as the first picture's camera would have seen all of it, where camera.npy tells that."""
    beside = path.parent.parent / "camera.npy"
    if not beside.is_file():
        return poses, transl, "no camera.npy in the folder above; the camera is taken as still"
    camera = read_boxed(beside)
    turns = _numbers(camera, "pred_cam_R", (3, 3), beside)
    moves = _numbers(camera, "pred_cam_T", (3,), beside, len(turns))
    if not 0 <= numbers.min() <= numbers.max() < len(turns):
        raise CaphyError(
            f"{beside}: holds {len(turns)} pictures, the track those from {numbers.min()} to {numbers.max()}"
        )
    axis_angles(turns, f"{beside}: pred_cam_R")  # raises where they are no rotations
    turns, moves = turns[numbers], moves[numbers]
    poses = poses.copy()
    poses[:, 0] = axis_angles(turns @ matrix_from_axis_angle(poses[:, 0]), str(path))
    placed = np.einsum("tij,tj->ti", turns, transl + pelvis) + moves  # the root turns about the pelvis
    return poses, placed - pelvis, "the camera's motion is that of camera.npy, in the first picture's axes"


def _numbers(results: Any, name: str, shape: tuple[int, ...], path: Path, count: int | None = None) -> np.ndarray:
    """The array (count, *shape) of a name."""
    values = results.get(name) if isinstance(results, dict) else None
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu" or not len(values):
        raise CaphyError(f"{path}: must hold {name}, an array of numbers, as TRAM writes it")
    if values.shape != (len(values) if count is None else count, *shape):
        wanted = ", ".join(map(str, ("frames" if count is None else count, *shape)))
        raise CaphyError(f"{path}: {name} must have shape ({wanted}), got {values.shape}")
    return values.astype(np.float64)
