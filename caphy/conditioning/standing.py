"""The pose that a body takes which nobody sees."""

from __future__ import annotations

import numpy as np

from caphy.conditioning.quaternions import exponential, product
from caphy.conventions import JOINT_COUNT, JOINT_NAMES
from caphy.io.procedural_actions import stand


def standing_pose() -> np.ndarray:
    """Standing at ease, arms hanging, as unit quaternions (55, 4)."""
    quaternions = np.zeros((JOINT_COUNT, 4))
    quaternions[:, 0] = 1
    for name, angles in stand(np.zeros(1)).items():
        a, b, c = exponential(np.radians(np.concatenate(angles))[:, None] * np.eye(3))
        quaternions[JOINT_NAMES.index(name)] = product(product(a, b), c)
    return quaternions
