"""One made-up motion, and what a bad estimator makes of it."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.conditioning.body import bundled_body
from caphy.conditioning.quaternions import exponential, logarithm, product
from caphy.io.poses import PoseSequence
from caphy.io.procedural import procedural_motion


@pytest.fixture(scope="session")
def walking() -> PoseSequence:
    """Eight seconds at 30 Hz: standing, walking, turning, raising arms."""
    return procedural_motion(3, 8.0, 30.0)


@pytest.fixture(scope="session")
def body():
    return bundled_body()


@pytest.fixture(scope="session")
def shaken(walking) -> np.ndarray:
    """Poses (T, 55, 3) of the motion with 6 degrees of noise in each body joint."""
    errors = np.random.default_rng(5).normal(size=walking.poses.shape) * np.radians(6) / np.sqrt(3)
    errors[:, 22:] = 0
    return logarithm(product(exponential(walking.poses), exponential(errors)))
