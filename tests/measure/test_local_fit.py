"""Local quadratics and the noise they leave, against numpy's polynomials and known noise."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.io.measurements import Measurement
from caphy.measure.local_fit import cubic_residuals, local_quadratic
from caphy.measure.noise import measurement_noise, overstated, understated
from caphy.measure.remarks import remarks

FACES = np.array([[0, 1, 2]])


def tracks(frames: int = 60, vertices: int = 200, sigma: float = 0.0, seed: int = 0) -> np.ndarray:
    """Vertices that swing at up to 0.8 Hz by 10 cm, with noise."""
    random, t = np.random.default_rng(seed), np.arange(frames)[:, None, None] / 30
    speed, phase = random.uniform(1, 5, (vertices, 3)), random.uniform(0, 6, (vertices, 3))
    return 0.1 * np.sin(speed * t + phase) + random.normal(0, sigma, (frames, vertices, 3))


def test_quadratic_agrees_with_polyfit_through_holes():
    y = tracks(12, 6, 0.01)
    seen = np.ones((12, 6), bool)
    seen[5, 1] = seen[7, 1] = False
    seen[4:8, 2] = False  # three frames are only found farther away
    seen[2:10, 3] = False  # nothing near
    fit = local_quadratic(np.where(seen[..., None], y, np.nan), seen, 30.0, 6)
    for v, reach in ((0, 2), (1, 2), (2, 4)):
        frames = [k for k in range(6 - reach, 6 + reach + 1) if 0 <= k < 12 and seen[k, v]]
        for axis in range(3):
            a, b, c = np.polyfit((np.array(frames) - 6) / 30, y[frames, v, axis], 2)
            got = fit.position[v, axis], fit.velocity[v, axis], fit.acceleration[v, axis]
            np.testing.assert_allclose(got, (c, b, 2 * a), rtol=1e-8, atol=1e-9)
    assert fit.known.tolist() == [True, True, True, False, True, True]


def test_residuals_of_cubics_vanish_and_those_of_noise_are_its_variance():
    t = np.arange(9.0)[:, None, None]
    cubic = 1 + t - 0.3 * t**2 + 0.02 * t**3 + np.zeros((9, 4, 3))
    seen = np.ones((9, 4), bool)
    assert cubic_residuals(cubic, seen).max() < 1e-20
    noise = np.random.default_rng(0).normal(0, 2.0, (9, 4000, 3))
    assert cubic_residuals(noise, np.ones((9, 4000), bool)).mean() == pytest.approx(4.0, rel=0.03)
    seen[4, 0] = False
    assert np.isnan(cubic_residuals(cubic, seen)[:5, 0]).all()


@pytest.mark.parametrize("sigma", [0.0005, 0.001, 0.003])
def test_noise_is_estimated_within_a_tenth(sigma):
    measurement = Measurement("m", 30.0, vertices=tracks(sigma=sigma), faces=FACES)
    noise = measurement_noise(measurement)
    assert noise is not None
    assert noise.sigma == pytest.approx(sigma, rel=0.1)
    assert "estimated" in noise.source


def test_stated_noise_wins_and_clouds_have_a_thickness():
    stated = Measurement("m", 30.0, vertices=tracks(), faces=FACES, noise_mm=1.25)
    assert measurement_noise(stated).sigma == pytest.approx(0.00125)
    random = np.random.default_rng(0)
    flat = np.concatenate([random.uniform(0, 0.3, (3000, 2)), random.normal(0, 0.001, (3000, 1))], axis=1)
    cloud = Measurement("m", 30.0, points=flat, offsets=np.array([0, 3000]))
    assert measurement_noise(cloud).sigma == pytest.approx(0.001, rel=0.15)


def cloud_of(points: np.ndarray, **keys) -> Measurement:
    return Measurement("m", 30.0, points=points, offsets=np.array([0, len(points)]), **keys)


@pytest.mark.parametrize(
    ("count", "sigma"), [(2500, 0.002), (20_000, 0.002), (20_000, 0.004), (86_000, 0.0005), (100_000, 0.003)]
)
def test_dense_clouds_are_as_thick_as_they_are(count, sigma):
    """However many points lie within the noise of each; cloth rolled up with a radius of 3 cm bends by little more."""
    random = np.random.default_rng(0)
    u, v = random.uniform(0, 0.4, (2, count))
    noise = random.normal(0, sigma, (count, 3))
    flat = cloud_of(np.stack([u, v, np.zeros(count)], axis=1) + noise)
    assert measurement_noise(flat).sigma == pytest.approx(sigma, rel=0.125)
    turn = u / 0.03
    rolled = np.stack([0.03 * np.cos(turn), v, 0.03 * np.sin(turn)], axis=1)[turn < 2 * np.pi]
    assert measurement_noise(cloud_of(rolled + noise[: len(rolled)])).sigma == pytest.approx(sigma, rel=0.2)


def test_dense_noise_that_is_there_is_not_doubted():
    random = np.random.default_rng(0)
    points = np.concatenate([random.uniform(0, 0.4, (100_000, 2)), np.zeros((100_000, 1))], axis=1)
    assert overstated(cloud_of(points + random.normal(0, 0.004, points.shape), noise_mm=4.0)) is None


@pytest.mark.parametrize(("stated_mm", "doubted"), [(50.0, True), (1.0, False), (2.0, False), (None, False)])
def test_noise_that_the_data_do_not_show_is_doubted(stated_mm, doubted):
    random = np.random.default_rng(0)
    flat = np.concatenate([random.uniform(0, 0.3, (3000, 2)), random.normal(0, 0.001, (3000, 1))], axis=1)
    cloud = Measurement("m", 30.0, points=flat, offsets=np.array([0, 3000]), noise_mm=stated_mm)
    track = Measurement("m", 30.0, vertices=tracks(sigma=0.001), faces=FACES, noise_mm=stated_mm)
    for measurement in (cloud, track):
        said = overstated(measurement)
        assert (said is not None) == doubted
        assert said is None or "m states noise of 50 mm but scatters by 1" in said or "by 0.9" in said


@pytest.mark.parametrize(
    ("stated_mm", "doubted"), [(0.001, True), (0.0, True), (0.3, False), (1.0, False), (None, False)]
)
def test_less_noise_than_the_data_show_is_doubted(stated_mm, doubted):
    """As where it was given in metres."""
    track = Measurement("m", 30.0, vertices=tracks(sigma=0.001), faces=FACES, noise_mm=stated_mm)
    said = understated(track)
    assert (said is not None) == doubted
    assert said is None or "mm but scatters by 1" in said or "by 0.9" in said
    assert (said in remarks([track])) == doubted
