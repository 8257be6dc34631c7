"""Which held-out scans are nearer to those trained on, and which are farther."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from caphy.conventions import BODY_JOINT_COUNT
from caphy.errors import CaphyError
from caphy.rotations import matrix_from_axis_angle

LIKE, UNLIKE = "nearer to those trained on", "farther from them"
"""Classes where none are given: the nearer and the farther half."""
HELD_OUT: Final = 0.2
"""Share of the scans that a split holds out."""


def pose_distances(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Mean angle [rad] between the joint rotations of poses (N, 55, 3) and others (M, 55, 3), (N, M).

    Of the 21 body joints below the root: where somebody stands and which way they face does not count.
    """
    a, b = (matrix_from_axis_angle(np.asarray(p)[:, 1:BODY_JOINT_COUNT]) for p in (poses, others))
    trace = np.einsum("njab,mjab->nmj", a, b)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1)).mean(axis=2)


def like_and_unlike(names: Sequence[str], distances: np.ndarray) -> dict[str, str]:
    """Class of each scan by its distance (N,) from the nearest trained pose: the nearer half, and the farther."""
    order = np.argsort(distances, kind="stable")
    near = set(order[: (len(order) + 1) // 2].tolist())
    return {name: LIKE if i in near else UNLIKE for i, name in enumerate(names)}


def read_classes(path: Path, names: Sequence[str]) -> dict[str, str]:
    """Motion class of each scan in ``names`` from a JSON object, scan to class.

    Raises:
        CaphyError: the file is no such object, or a scan is missing.
    """
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(given, Mapping):
            raise ValueError("it is no object")
    except (OSError, ValueError) as error:
        raise CaphyError(f'{path}: must be a JSON object such as {{"scan_001": "running"}}: {error}') from error
    missing = [name for name in names if not isinstance(given.get(name), str)]
    if missing:
        raise CaphyError(f"{path}: names no class for {', '.join(missing[:5])}; every held-out scan needs one")
    return {name: given[name] for name in names}


def unlike_split(names: Sequence[str], poses: np.ndarray) -> dict[str, list[str]]:
    """A split that holds out a fifth of the scans whose poses (N, 55, 3) form the group least like the rest.

    They are the scan farthest from all others on average, and those nearest to it: how well an avatar extrapolates.
    """
    distances = pose_distances(poses, poses)
    count = max(1, round(HELD_OUT * len(names))) if len(names) > 1 else 0
    first = int(distances.mean(axis=1).argmax())
    held = set(np.argsort(distances[first], kind="stable")[:count].tolist())
    return {
        "train": [name for i, name in enumerate(names) if i not in held],
        "held_out": [name for i, name in enumerate(names) if i in held],
    }
