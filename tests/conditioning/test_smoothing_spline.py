"""The spline's weights against a Kalman filter with a Rauch-Tung-Striebel smoother, which steps through time."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.conditioning.spline import spline_weights


def rts(times: np.ndarray, values: np.ndarray, noise: np.ndarray, drive: float, wanted: float) -> float:
    """Value at ``wanted`` of a path whose velocity is a Wiener process of density ``drive``, seen with variances
    ``noise``: textbook Kalman filter over the times and ``wanted``, then RTS backwards; nothing known at first."""
    every = np.union1d(times, [wanted])
    mean, cov = np.zeros(2), np.eye(2) * 1e8
    filtered, predicted = [], []
    for i, time in enumerate(every):
        step = time - every[i - 1] if i else 0.0
        move = np.array([[1.0, step], [0.0, 1.0]])
        shake = drive * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        mean, cov = move @ mean, move @ cov @ move.T + shake
        predicted.append((mean, cov, move))
        if time in times:
            at = int(np.flatnonzero(times == time)[0])
            gain = cov[:, 0] / (cov[0, 0] + noise[at])
            mean = mean + gain * (values[at] - mean[0])
            keep = np.eye(2) - np.outer(gain, [1.0, 0.0])
            cov = keep @ cov @ keep.T + noise[at] * np.outer(gain, gain)
        filtered.append((mean, cov))
    mean, cov = filtered[-1]
    found = {float(every[-1]): mean[0]}
    for i in range(len(every) - 2, -1, -1):
        ahead_mean, ahead_cov, move = predicted[i + 1]
        back = filtered[i][1] @ move.T @ np.linalg.inv(ahead_cov)
        mean = filtered[i][0] + back @ (mean - ahead_mean)
        found[float(every[i])] = mean[0]
    return found[float(wanted)]


@pytest.mark.parametrize("wanted", [0.0, 0.11, 0.3, 0.41, 0.55])
def test_equals_the_kalman_smoother(wanted):
    rng = np.random.default_rng(3)
    times = np.array([0.0, 0.03, 0.07, 0.11, 0.2, 0.23, 0.3, 0.36, 0.41])
    values, trust = rng.normal(size=9), rng.uniform(0.2, 1.0, 9)
    precision, stiffness = trust / 30, 1e-5
    weights = spline_weights(times, precision, stiffness, wanted)
    expected = rts(times, values, 1 / precision, 1 / stiffness, wanted)
    assert weights @ values == pytest.approx(expected, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("count", [1, 2, 3, 16])
@pytest.mark.parametrize("wanted", [-0.1, 0.0, 0.21, 0.9])
def test_straight_lines_stay(count, wanted):
    times = np.cumsum(np.random.default_rng(count).uniform(0.01, 0.1, count))
    weights = spline_weights(times, np.full(count, 1 / 30), 1e-5, wanted)
    assert weights.sum() == pytest.approx(1)
    if count > 1:
        assert weights @ times == pytest.approx(wanted)


def test_stiffer_is_calmer():
    times, noisy = np.arange(16) / 30, np.random.default_rng(0).normal(size=16)
    rough = [
        np.abs(np.diff([spline_weights(times, np.full(16, 1 / 30), s, t) @ noisy for t in times], 2)).max()
        for s in (1e-9, 1e-6, 1e-3)
    ]
    assert rough[0] > 3 * rough[1] > 9 * rough[2]
