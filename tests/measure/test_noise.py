"""How much clouds scatter, told from their own points."""

import numpy as np
import pytest

from caphy.io.measurements import Measurement
from caphy.measure.noise import scatter


def _cloud(count: int, radius: float) -> Measurement:
    """Points (count, 3) at random on a cylinder a metre long, with noise of 1 mm."""
    random = np.random.default_rng(0)
    angle, height = random.uniform(0, 2 * np.pi, (3, count)), random.uniform(0, 1, (3, count))
    points = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], -1)
    points += 1e-3 * random.normal(size=points.shape)
    return Measurement("cloud", 30.0, points=points.reshape(-1, 3), offsets=count * np.arange(4))


def test_sparse_clouds_of_sharply_curved_cloth_do_not_tell_their_noise():
    """Twelve neighbours that span a leg lie nowhere near a plane: 9 mm were told of them."""
    assert scatter(_cloud(20_000, 0.08)).sigma == pytest.approx(1e-3, rel=0.3)
    assert scatter(_cloud(300, 0.08)) is None
