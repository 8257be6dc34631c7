"""How far joints turn: what a pose shows beyond that is brought back, gently."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.conventions import BODY_JOINT_COUNT, JOINT_COUNT, JOINT_NAMES
from caphy.io.procedural_limits import limits

MARGIN: Final = np.radians(20.0)
"""Added to the ranges that captured motions keep to [rad]."""
SOFT: Final = np.radians(10.0)
"""Beyond a range, angles approach range + this and never reach it [rad]."""
WIDE: Final = {"shoulder": np.pi, "hip": np.radians(140.0), "elbow": np.radians(160.0)}
"""Least range either way of joints whose rotation vectors mix all three axes [rad]."""


def reaches() -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest components (55, 3) of the joints' rotation vectors [rad]; what has no range is free."""
    ranges = limits()
    low, high = ranges[..., 0] - MARGIN, ranges[..., 1] + MARGIN
    for joint, name in enumerate(JOINT_NAMES):
        least = next((angle for part, angle in WIDE.items() if name.endswith(part)), 0.0)
        low[joint] = np.minimum(low[joint], -least)
        high[joint] = np.maximum(high[joint], least)
    free = np.array([j == 0 or j >= BODY_JOINT_COUNT for j in range(JOINT_COUNT)])
    low[free], high[free] = -np.inf, np.inf
    return low, high


LOW, HIGH = reaches()


def within_reach(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors (55, 3) [rad] brought back into reach, and which joints (55,) were beyond it."""
    over, under = np.maximum(vectors - HIGH, 0), np.maximum(LOW - vectors, 0)
    brought = np.clip(vectors, LOW, HIGH) + SOFT * (np.tanh(over / SOFT) - np.tanh(under / SOFT))
    return brought, np.any((over > 0) | (under > 0), axis=-1)
