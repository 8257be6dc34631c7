"""Columns of SMPL-family pose vectors, sorted into SMPL-X's 55 joints."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.conventions import BODY_JOINT_COUNT, JOINT_COUNT
from caphy.errors import CaphyError
from caphy.io.poses.sequence import SMPL_PELVIS, SMPLX_PELVIS
from caphy.rotations import axis_angle_from_matrix

HANDS: Final = slice(25, 55)

LAYOUTS: Final = {
    165: ("smplx", "SMPL-X: root, 21 body, jaw, eyes, 15 + 15 hand joints"),
    156: ("smplh", "SMPL-H: root, 21 body, 15 + 15 hand joints"),
    72: ("smpl", "SMPL: root, 21 body, 2 hands"),
}
"""Pose vector widths that say which joints they hold."""
NEARLY: Final = 0.02
"""How far from orthogonal matrices in 16-bit floats may be."""


def poses_from_columns(columns: np.ndarray, where: str) -> tuple[np.ndarray, str, tuple[str, ...]]:
    """Poses (T, 55, 3), model and notes of pose vectors (T, 72, 156 or 165); :class:`CaphyError` for others."""
    if columns.ndim != 2 or columns.shape[1] not in LAYOUTS:
        known = "; ".join(f"{width} ({text})" for width, (_, text) in LAYOUTS.items())
        raise CaphyError(f"{where}: poses must have one row per frame of {known}; got shape {columns.shape}")
    if not len(columns):
        raise CaphyError(f"{where}: holds no frames; poses has shape {columns.shape}")
    joints = columns.reshape(len(columns), -1, 3)
    poses = np.zeros((len(columns), JOINT_COUNT, 3))
    poses[:, :BODY_JOINT_COUNT] = joints[:, :BODY_JOINT_COUNT]
    model = LAYOUTS[columns.shape[1]][0]
    if model == "smplx":
        return joints.copy(), model, ()
    same = f"{model} rotations are used on SMPL-X joints, whose rest pose differs by a few degrees"
    if model == "smplh":
        poses[:, HANDS] = joints[:, BODY_JOINT_COUNT:]
        return poses, model, (same,)
    return poses, model, (same, "the last two of SMPL's 24 joints (hands) are left out; fingers rest")


def rest_pelvis(
    model: str, gender: str, betas: np.ndarray | None
) -> tuple[tuple[float, float, float], tuple[str, ...]]:
    """Rest pelvis (3,) [m] that a translation refers to, and what was assumed about it."""
    pelvis = SMPLX_PELVIS if model == "smplx" else SMPL_PELVIS.get(gender, SMPL_PELVIS["neutral"])
    shaped = betas is not None and bool(np.any(betas))
    note = f"translation refers to the {model} pelvis at mean shape; with the file's betas it is off by centimetres"
    return pelvis, (note,) if shaped else ()


def mean_betas(betas: np.ndarray, where: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """One set of shape coefficients from one per frame (T, B) or (B,)."""
    betas = np.atleast_2d(betas)
    if betas.ndim != 2 or not np.isfinite(betas).all():
        raise CaphyError(f"{where}: betas must be finite, of shape (B,) or (frames, B); got {betas.shape}")
    varies = len(betas) > 1 and float(np.ptp(betas, axis=0).max()) > 1e-6
    return np.median(betas, axis=0), ("betas vary from frame to frame; their median is used",) if varies else ()


def require_fps(fps: float | None, where: str, why: str) -> float:
    """The frame rate given by the user; :class:`CaphyError` asking for it where there is none."""
    if fps is None:
        raise CaphyError(f"{where}: {why}; give the true frame rate with 'caphy poses convert --fps RATE'")
    return fps


def axis_angles(rotations: np.ndarray, where: str) -> np.ndarray:
    """Rotation vectors (..., 3) [rad] of matrices (..., 3, 3); :class:`CaphyError` where they are no rotations."""
    if rotations.ndim < 2 or rotations.shape[-2:] != (3, 3) or not np.isfinite(rotations).all():
        raise CaphyError(f"{where}: must be finite rotation matrices (..., 3, 3), got shape {rotations.shape}")
    off = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    if off.max(initial=0.0) > NEARLY or (np.linalg.det(rotations) < 0).any():
        raise CaphyError(f"{where}: must be rotations; {int((off > NEARLY).sum())} of {off.size} matrices are not")
    return axis_angle_from_matrix(rotations)
