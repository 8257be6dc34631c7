"""How likely a posture is as a whole: joints that each are within their limits may together be no body's."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

import caphy
from caphy.conventions import BODY_JOINT_COUNT

STATISTICS: Final = Path(caphy.__file__).parent / "data" / "pose_statistics.npz"
"""Mean and covariance of the 21 body joints' rotation vectors over 26 CMU clips, left and right alike."""
OTHER: Final = np.radians(8.0)
"""Added to the spread of every angle: there are other postures than those of the clips [rad]."""
MOST: Final = 350.0
"""Squared distance beyond which a posture is none. Of 11 captured clips the furthest is 171, a deep crouch with the
back bent 240, random turns of one radian rms in every joint 670 and more."""


def unlikeliness(vectors: np.ndarray, trust: np.ndarray) -> float:
    """Squared Mahalanobis distance of rotation vectors (55, 3) [rad] from captured postures; joints of no ``trust``
    (55,) are taken as the mean."""
    mean, precision = _statistics()
    seen = np.repeat(trust[1:BODY_JOINT_COUNT] > 0, 3)
    away = np.where(seen, vectors[1:BODY_JOINT_COUNT].ravel() - mean, 0.0)
    return float(away @ precision @ away)


@lru_cache(maxsize=1)
def _statistics() -> tuple[np.ndarray, np.ndarray]:
    with np.load(STATISTICS, allow_pickle=False) as arrays:
        mean, covariance = arrays["mean"].astype(np.float64), arrays["covariance"].astype(np.float64)
    return mean, np.linalg.inv(covariance + OTHER**2 * np.eye(len(mean)))
