"""Results of WHAM (Shin et al., CVPR 2024): ``wham_output.pkl``, written by joblib, y up, SMPL's 24 joints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.estimated import estimated
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.smpl import poses_from_columns, require_fps


def read_wham(results: Any, path: Path, fps: float | None, person: int | None = None) -> PoseSequence:
    """One person's motion; ``fps`` [Hz] is the video's and must be given. Raises :class:`CaphyError`."""
    subject, key = _subject(results, path, person)
    fps = require_fps(fps, str(path), "WHAM does not keep the video's frame rate")
    poses, model, notes = poses_from_columns(_numbers(subject, "pose_world", path), str(path))
    transl = _numbers(subject, "trans_world", path).reshape(-1, 3)
    if len(transl) != len(poses):
        raise CaphyError(f"{path}: trans_world has {len(transl)} frames, pose_world {len(poses)}")
    betas = _numbers(subject, "betas", path) if "betas" in subject else None
    ids = _numbers(subject, "frame_ids", path) if "frame_ids" in subject else np.arange(len(poses))
    return estimated(path, fps, poses, transl, ids.ravel().astype(int), betas, model, (f"person {key}", *notes))


def _subject(results: Any, path: Path, person: int | None) -> tuple[dict[str, Any], Any]:
    found = dict(results) if isinstance(results, dict) else {}
    found = {key: value for key, value in found.items() if isinstance(value, dict) and "pose_world" in value}
    if not found:
        raise CaphyError(
            f"{path}: must hold {{person: {{pose_world, trans_world, ...}}}} as WHAM writes it, "
            "smplx_params as PyMAF-X, or {frame: {tid, smpl, ...}} as PHALP (4D-Humans)"
        )
    if person is None and len(found) > 1:
        raise CaphyError(
            f"{path}: holds {len(found)} persons ({', '.join(map(str, found))}); "
            "choose with 'caphy poses convert --person'"
        )
    key = next(iter(found)) if person is None else person
    if key not in found:
        raise CaphyError(f"{path}: there is no person {key}; it holds {', '.join(map(str, found))}")
    return found[key], key


def _numbers(subject: dict[str, Any], name: str, path: Path) -> np.ndarray:
    values = subject.get(name)
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu" or values.size == 0:
        raise CaphyError(f"{path}: {name} must be an array of numbers, got {type(values).__name__}")
    return values.astype(np.float64)
