"""What a caller says was seen, as arrays of the right shapes."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.conventions import JOINT_COUNT, JOINT_NAMES
from caphy.errors import CaphyError
from caphy.rotations import quaternion_from_matrix

LEAST_TRUST: Final = 0.05
"""Confidence below which a joint counts as not seen."""
ROUNDING: Final = 1e-3
"""By which confidences may lie beyond 0 and 1."""


def checked(
    poses: np.ndarray | None, transl: np.ndarray | None, confidence: np.ndarray | float | None
) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray]:
    """Arrays of the right shapes; joints with values that are not finite are not trusted.

    Raises CaphyError for other shapes, and for confidences that are no shares, such as percent.
    """
    if poses is None:
        return None, None, np.zeros(JOINT_COUNT)
    poses = np.array(poses, np.float64)
    if poses.shape != (JOINT_COUNT, 3):
        raise CaphyError(f"poses must have shape ({JOINT_COUNT}, 3), SMPL-X's joints in its order, got {poses.shape}")
    trust = np.ones(JOINT_COUNT) if confidence is None else np.array(confidence, np.float64)
    if trust.shape not in ((), (JOINT_COUNT,)):
        raise CaphyError(f"confidence must be one number or ({JOINT_COUNT},), got shape {trust.shape}")
    bad = np.flatnonzero((trust < -ROUNDING) | (trust > 1 + ROUNDING))
    if len(bad):
        where = f" at joint {bad[0]} ({JOINT_NAMES[bad[0]]})" if trust.ndim else ""
        raise CaphyError(f"confidence must lie between 0, not seen, and 1, sure, got {trust.flat[bad[0]]:g}{where}")
    trust = np.nan_to_num(trust, nan=0.0)
    trust = np.broadcast_to(np.clip(trust, 0, 1), JOINT_COUNT)
    bad = ~np.isfinite(poses).all(axis=1)
    poses[bad] = 0.0
    trust = np.where(bad | (trust < LEAST_TRUST), 0.0, trust)
    if transl is not None:
        transl = np.array(transl, np.float64)
        if transl.shape != (3,):
            raise CaphyError(f"transl must have shape (3,), got {transl.shape}")
        transl = transl if np.isfinite(transl).all() else None
    return poses, transl, trust


def camera_rotation(rotation: np.ndarray) -> np.ndarray:
    """A camera's rotation as a quaternion (4,)."""
    matrix = np.array(rotation, np.float64)
    if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
        raise CaphyError(f"camera must be a rotation (3, 3) from the camera's axes to the world's, got {matrix}")
    return quaternion_from_matrix(matrix)
