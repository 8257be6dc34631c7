"""How much clouds scatter, told from their own points."""

import numpy as np
import pytest

from caphy.io.measurements import Measurement
from caphy.measure.noise import measurement_noise, noise_distance, scatter


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


@pytest.mark.parametrize("noisy", [0.0, 0.4, 0.6, 1.0])
@pytest.mark.parametrize("coordinates", [1, 3])
def test_distances_of_mixed_noise_are_those_of_draws(noisy, coordinates):
    """The median over points of their noise says nothing of it: of 40 and 60 % it is one or the other."""
    random = np.random.default_rng(0)
    sigma = np.where(np.arange(400_000) % 10 < 10 * noisy, 5e-3, 0.3e-3)
    drawn = np.linalg.norm(random.normal(size=(len(sigma), coordinates)) * sigma[:, None], axis=1)
    for share in (0.5, 0.95):
        assert noise_distance(sigma, coordinates, share) == pytest.approx(np.quantile(drawn, share), rel=0.02)


def test_noise_of_what_was_not_seen_does_not_count():
    random = np.random.default_rng(0)
    noise = np.where(np.arange(10) < 6, 9e-3, 1e-3)
    seen = np.broadcast_to(np.arange(10) >= 4, (8, 10))
    vertices = random.normal(size=(8, 10, 3))
    faces = np.array([[0, 1, 2]])
    assert measurement_noise(Measurement("m", 30.0, vertices=vertices, faces=faces, noise=noise)).sigma == 9e-3
    found = measurement_noise(Measurement("m", 30.0, vertices=vertices, faces=faces, noise=noise, visibility=seen))
    assert found.sigma == 1e-3
