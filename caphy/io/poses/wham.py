"""Results of WHAM (Shin et al., CVPR 2024): ``wham_output.pkl``, written by joblib, y up, SMPL's 24 joints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.gaps import without_gaps
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.smpl import mean_betas, poses_from_columns, require_fps, rest_pelvis


def read_wham(results: Any, path: Path, fps: float | None, person: int | None = None) -> PoseSequence:
    """One person's motion; ``fps`` [Hz] is the video's and must be given. Raises :class:`CaphyError`."""
    fps = require_fps(fps, str(path), "WHAM does not keep the video's frame rate")
    subject, key = _subject(results, path, person)
    poses, model, notes = poses_from_columns(_numbers(subject, "pose_world", path), str(path))
    transl = _numbers(subject, "trans_world", path).reshape(-1, 3)
    if len(transl) != len(poses):
        raise CaphyError(f"{path}: trans_world has {len(transl)} frames, pose_world {len(poses)}")
    betas, more = mean_betas(_numbers(subject, "betas", path), str(path)) if "betas" in subject else (None, ())
    pelvis, shaped = rest_pelvis(model, "neutral", betas)
    ids = _numbers(subject, "frame_ids", path) if "frame_ids" in subject else np.arange(len(poses))
    poses, transl, gaps = without_gaps(poses, transl, ids.ravel().astype(int), str(path))
    return PoseSequence(
        poses=poses,
        transl=transl,
        fps=fps,
        source=str(path),
        betas=betas,
        model=model,
        pelvis=pelvis,
        notes=(f"person {key}", *notes, *more, *shaped, *gaps),
    )


def _subject(results: Any, path: Path, person: int | None) -> tuple[dict[str, Any], Any]:
    found = dict(results) if isinstance(results, dict) else {}
    found = {key: value for key, value in found.items() if isinstance(value, dict) and "pose_world" in value}
    if not found:
        raise CaphyError(
            f"{path}: must hold {{person: {{pose_world, trans_world, ...}}}} as WHAM writes it, "
            "smplx_params as PyMAF-X, or {frame: {tid, smpl, ...}} as PHALP (4D-Humans)"
        )
    if person is None and len(found) > 1:
        raise CaphyError(f"{path}: holds {len(found)} persons ({', '.join(map(str, found))}); choose with --person")
    key = next(iter(found)) if person is None else person
    if key not in found:
        raise CaphyError(f"{path}: there is no person {key}; it holds {', '.join(map(str, found))}")
    return found[key], key


def _numbers(subject: dict[str, Any], name: str, path: Path) -> np.ndarray:
    values = subject.get(name)
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu" or values.size == 0:
        raise CaphyError(f"{path}: {name} must be an array of numbers, got {type(values).__name__}")
    return values.astype(np.float64)
