"""A motion of any skeleton, as motion capture files hold it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caphy.errors import CaphyError
from caphy.rotations import matrix_from_axis_angle


@dataclass(frozen=True, eq=False)
class SkeletonMotion:
    """T frames of a skeleton of K joints, in the file's own length unit; y up.

    names: joint names, parents before children; the first is the root.
    parents: (K,) index of each joint's parent, -1 for the root.
    offsets: (K, 3) position of each joint from its parent in the zero pose.
    tips: (K, 3) offset of the end site of a joint without children, else zero.
    rotations: (T, K, 3, 3) rotation of each joint from the zero pose, in its parent's frame.
    root: (T, 3) position of the root.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    tips: np.ndarray
    rotations: np.ndarray
    root: np.ndarray
    fps: float
    source: str
    notes: tuple[str, ...] = ()

    def world(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (T, K, 3, 3) from the zero pose and positions (T, K, 3) of every joint in the world."""
        return forward_kinematics(self.rotations, self.offsets, self.parents, self.root)


def forward_kinematics(
    rotations: np.ndarray, offsets: np.ndarray, parents: np.ndarray, root: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (T, K, 3, 3) and positions (T, K, 3) of joints with local ``rotations`` (T, K, 3, 3).

    ``offsets`` (K, 3) lead from each parent, ``root`` (T, 3) is the first joint's position.
    """
    turned, positions = np.empty_like(rotations), np.empty(rotations.shape[:-1])
    turned[:, 0], positions[:, 0] = rotations[:, 0], root
    for joint in range(1, len(parents)):
        parent = parents[joint]
        turned[:, joint] = turned[:, parent] @ rotations[:, joint]
        positions[:, joint] = positions[:, parent] + turned[:, parent] @ offsets[joint]
    return turned, positions


def axis_rotations(axis: int, angles: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) about coordinate axis 0, 1 or 2 by ``angles`` (...) [rad]."""
    return matrix_from_axis_angle(angles[..., None] * np.eye(3)[axis])


def read_text(path: Path) -> str:
    """The text of a file; raises :class:`CaphyError` where it cannot be read as such."""
    try:
        return path.read_text(encoding="utf-8-sig", errors="strict")
    except (OSError, UnicodeDecodeError) as error:
        raise CaphyError(f"{path}: cannot be read as text: {error}") from error
