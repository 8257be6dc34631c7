"""Results of PyMAF-X (Zhang et al., TPAMI 2023): ``output.pkl``, written by joblib.

``smplx_params`` is a list of the network's batches, each of tensors: body_pose (B, 22, 3, 3) with the root first,
left_hand_pose and right_hand_pose (B, 15, 3, 3), jaw_pose, leye_pose, reye_pose (B, 1, 3, 3), shape (B, 10).
``orig_cam_t`` (N, 3) is the translation [m] for a focal length of 5000 pixels; ``orig_cam``, ``pred_cam`` and
``bboxes`` tell the picture's size. ``frame_ids`` (N,), ``person_ids`` of the N. In the camera's axes.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.camera import at_usual_distance, level_camera
from caphy.io.poses.estimated import estimated
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.smpl import axis_angles, require_fps

FOCAL: Final = 5000.0
"""[pixels]"""
PARTS: Final = {
    "body_pose": 22,
    "jaw_pose": 1,
    "leye_pose": 1,
    "reye_pose": 1,
    "left_hand_pose": 15,
    "right_hand_pose": 15,
}
"""Joints of each part, in SMPL-X's order."""


def is_pymafx(results: Any) -> bool:
    """Whether a pickle's content is PyMAF-X's."""
    return isinstance(results, dict) and isinstance(results.get("smplx_params"), list)


def read_pymafx(results: dict[str, Any], path: Path, fps: float | None, person: int | None = None) -> PoseSequence:
    """One person's motion; ``fps`` [Hz] is the video's and must be given. Raises :class:`CaphyError`."""
    fps = require_fps(fps, str(path), "PyMAF-X does not keep the video's frame rate")
    parts = [_joined(results["smplx_params"], name, (count, 3, 3), path) for name, count in PARTS.items()]
    rotations = np.concatenate(parts, axis=1)
    shapes = _joined(results["smplx_params"], "shape", (10,), path)
    rows, numbers, person = _rows(results, len(rotations), path, person)
    transl, more = _translations(results, len(rotations), path)
    poses = axis_angles(rotations[rows], str(path))
    said = f"person {person} of each frame; unless PyMAF-X was told to track, that is a place and not a person"
    return level_camera(estimated(path, fps, poses, transl[rows], numbers, shapes[rows], notes=(said, more)))


def _joined(batches: list[Any], name: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    """A part (N, *shape) of all batches."""
    if not batches:
        raise CaphyError(f"{path}: smplx_params is empty; nobody was found")
    return np.concatenate([_of_batch(batch, name, shape, path) for batch in batches])


def _of_batch(batch: Any, name: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    values = batch.get(name) if isinstance(batch, dict) else None
    if not isinstance(values, np.ndarray) or values.dtype.kind != "f" or values.shape[1:] != shape:
        got = values.shape if isinstance(values, np.ndarray) else type(values).__name__
        wanted = ", ".join(map(str, shape))
        raise CaphyError(f"{path}: smplx_params: {name} must have shape (batch, {wanted}), got {got}")
    return values.astype(np.float64)


def _rows(results: dict[str, Any], count: int, path: Path, person: int | None) -> tuple[np.ndarray, np.ndarray, int]:
    """The chosen person's rows in order of frames, their frames' numbers, and the person."""
    ids, persons = np.ravel(results.get("frame_ids", [])), list(results.get("person_ids", []))
    if len(ids) != count or len(persons) != count:
        raise CaphyError(f"{path}: frame_ids and person_ids must have {count} entries, got {len(ids)}, {len(persons)}")
    numbers = np.array([_person(name) for name in persons])
    found = np.unique(numbers)
    if person is None and len(found) > 1:
        raise CaphyError(
            f"{path}: holds {len(found)} persons ({', '.join(map(str, found))}); "
            "choose with 'caphy poses convert --person'"
        )
    person = int(found[0]) if person is None else person
    rows = np.flatnonzero(numbers == person)
    if not len(rows):
        raise CaphyError(f"{path}: there is no person {person}; it holds {', '.join(map(str, found))}")
    rows = rows[np.argsort(ids[rows], kind="stable")]
    return rows, ids[rows].astype(int), person


def _person(name: Any) -> int:
    """The number in a person's name: NAME_fFRAME_pPERSON, or a track."""
    match = re.search(r"(\d+)$", str(name))
    return int(match[1]) if match else 0


def _translations(results: dict[str, Any], count: int, path: Path) -> tuple[np.ndarray, str]:
    """Translations (N, 3) [m], and what is to be said of them."""
    if "orig_cam_t" not in results:
        return np.zeros((count, 3)), "no translation in the file; condition it with translation feet"
    needed = {"orig_cam_t": 3, "orig_cam": 4, "pred_cam": 3, "bboxes": 4}
    arrays = {name: np.asarray(results.get(name)) for name in needed}
    for name, width in needed.items():
        if arrays[name].dtype.kind not in "fiu" or arrays[name].shape != (count, width):
            raise CaphyError(f"{path}: {name} must be numbers of shape ({count}, {width}), got {arrays[name].shape}")
    scaled = arrays["pred_cam"][:, :1] * arrays["bboxes"][:, 2:3]
    size = scaled / np.where(arrays["orig_cam"][:, :2] == 0, np.nan, arrays["orig_cam"][:, :2])
    if not np.isfinite(size).all() or (size <= 0).any():
        raise CaphyError(f"{path}: orig_cam, pred_cam and bboxes must tell the picture's size, got {size.min():.3g}")
    place = at_usual_distance(arrays["orig_cam_t"].astype(np.float64), FOCAL, size)
    return place, "distance as of a focal length of the diagonal"
