"""The cubic smoothing spline through samples at any times, as weights of the samples.

The spline minimises ``sum_i w_i (y_i - x(t_i))^2 + stiffness * integral x''^2 dt``. It is the posterior mean of a path
whose velocity is a Wiener process, seen through white noise: what a Kalman filter with that model and a
Rauch-Tung-Striebel smoother over the same samples give, without stepping through time (Wahba 1978; Reinsch 1967;
Green and Silverman, "Nonparametric Regression and Generalized Linear Models", 1994, chapter 2).
"""

from __future__ import annotations

import numpy as np


def spline_weights(times: np.ndarray, precision: np.ndarray, stiffness: float, at: float) -> np.ndarray:
    """Weights (..., N) so that ``weights @ samples`` is the spline's value at the time ``at`` [s].

    times: (N,) of the samples, rising [s], N of at least 1. precision: (..., N) weights w of the samples [s], positive;
    every row of them has weights of its own. stiffness: [s^4]. Beyond the samples the spline goes straight on. The
    weights add up to one and reproduce any straight line.
    """
    count = len(times)
    if count < 3:
        return np.broadcast_to(_straight(times, at), precision.shape).copy()
    steps = np.diff(times)
    inner = np.arange(count - 2)
    differences = np.zeros((count - 2, count))
    differences[inner, inner] = 1 / steps[:-1]
    differences[inner, inner + 1] = -1 / steps[:-1] - 1 / steps[1:]
    differences[inner, inner + 2] = 1 / steps[1:]
    system = stiffness * (differences / precision[..., None, :]) @ differences.T
    system[..., inner, inner] += (steps[:-1] + steps[1:]) / 3
    system[..., inner[:-1], inner[1:]] += steps[1:-1] / 6
    system[..., inner[1:], inner[:-1]] += steps[1:-1] / 6
    values, curvatures = _at(times, steps, at)
    # value = values . x + curvatures . g with g = system^-1 differences y and x = y - stiffness / w differences^T g
    right = curvatures[1:-1] - stiffness * (values / precision) @ differences.T
    adjoint = np.linalg.solve(system, right[..., None])[..., 0]
    return values + adjoint @ differences


def _straight(times: np.ndarray, at: float) -> np.ndarray:
    if len(times) == 1:
        return np.ones(1)
    share = (at - times[0]) / (times[1] - times[0])
    return np.array([1 - share, share])


def _at(times: np.ndarray, steps: np.ndarray, at: float) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (N,) of the knots' values and of their second derivatives in the natural spline's value."""
    values, curvatures = np.zeros(len(times)), np.zeros(len(times))
    inside = min(max(at, times[0]), times[-1])
    i = min(max(int(np.searchsorted(times, inside, side="right")) - 1, 0), len(steps) - 1)
    step = steps[i]
    right = (inside - times[i]) / step
    left = 1 - right
    slope_left, slope_right = -(3 * left**2 - 1) * step / 6, (3 * right**2 - 1) * step / 6
    beyond = at - inside
    values[i], values[i + 1] = left - beyond / step, right + beyond / step
    curvatures[i] = (left**3 - left) * step**2 / 6 + beyond * slope_left
    curvatures[i + 1] = (right**3 - right) * step**2 / 6 + beyond * slope_right
    return values, curvatures
