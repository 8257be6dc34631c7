"""Results of GVHMR (Shen et al., SIGGRAPH Asia 2024): ``hmr4d_results.pt``.

``smpl_params_global`` has y up; ``smpl_params_incam`` is in the camera's view. Video frames are copied one to one into
a nominal 30 Hz, so the true frame rate is the video's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.camera import level_camera
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.smpl import mean_betas, require_fps, rest_pelvis

PARTS = {"global_orient": 3, "body_pose": 63, "transl": 3}


def read_gvhmr(path: Path, fps: float | None) -> PoseSequence:
    """The motion in a GVHMR result; ``fps`` [Hz] is the video's and must be given. Raises :class:`CaphyError`."""
    fps = require_fps(fps, str(path), "GVHMR copies video frames into a nominal 30 Hz")
    results = _load(path)
    world = "smpl_params_global" in results
    name = "smpl_params_global" if world else "smpl_params_incam"
    parameters = results.get(name)
    if not isinstance(parameters, dict) or not PARTS.keys() <= parameters.keys():
        raise CaphyError(f"{path}: must hold smpl_params_global with {', '.join(PARTS)}; got {sorted(results)}")
    arrays = {key: np.asarray(value, dtype=np.float64) for key, value in parameters.items()}
    frames = arrays["global_orient"].size // 3
    for key, width in PARTS.items():
        if arrays[key].size != frames * width or frames == 0:
            raise CaphyError(f"{path}: {name}.{key} must be ({frames}, {width}), got {arrays[key].shape}")
    poses = np.zeros((frames, 55, 3))
    poses[:, 0] = arrays["global_orient"].reshape(frames, 3)
    poses[:, 1:22] = arrays["body_pose"].reshape(frames, 21, 3)
    betas, notes = mean_betas(arrays["betas"], str(path)) if "betas" in arrays else (None, ())
    pelvis, more = rest_pelvis("smplx", "neutral", betas)
    sequence = PoseSequence(
        poses=poses,
        transl=arrays["transl"].reshape(frames, 3),
        fps=fps,
        source=str(path),
        betas=betas,
        pelvis=pelvis,
        notes=(*notes, *more, "fingers, jaw and eyes are not in the file and rest"),
    )
    return sequence if world else level_camera(sequence)


def _load(path: Path) -> dict[str, Any]:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise CaphyError(
            f"{path}: reading .pt files needs torch; install it with: pip install 'caphy[train]'"
        ) from error
    try:
        results = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises its own, pickle's, zip's and runtime errors alike
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CaphyError(f"{path}: cannot be read as tensors alone: {first}") from error
    if not isinstance(results, dict):
        raise CaphyError(f"{path}: must hold a dictionary of parameters, got {type(results).__name__}")
    return results
