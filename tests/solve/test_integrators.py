"""Integrators against exact solutions."""

import numpy as np
import pytest
import torch

from caphy.effects.base import Step
from caphy.solve.integrators import INTEGRATORS, SDIRK2, ImplicitEuler, State

FREQUENCY = 3.0


def oscillate(integrator, dt, steps, frequency=FREQUENCY):
    """A unit mass on a spring, its implicit step solved by formula."""

    def solve(step: Step, time: float):
        return step.target / (1 + (frequency * step.dt) ** 2)

    state = State(0.0, torch.ones(1, 3, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64))
    for _ in range(steps):
        state = integrator.advance(state, dt, solve)
    return float(state.x[0, 0]), float(state.v[0, 0])


@pytest.mark.parametrize("name", INTEGRATORS)
def test_order_of_convergence(name):
    integrator = INTEGRATORS[name]()
    errors = []
    for steps in (200, 400, 800):
        x, v = oscillate(integrator, 1.0 / steps, steps)
        errors.append(np.hypot(x - np.cos(FREQUENCY), v / FREQUENCY + np.sin(FREQUENCY)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, integrator.order, atol=0.05)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_stiff_motion_dies_at_once(name):
    """L-stability: a spring a million times faster than the step is gone after a few steps."""
    x, _ = oscillate(INTEGRATORS[name](), 1.0, 3, frequency=1e6)
    assert abs(x) < 1e-5


def test_sdirk2_keeps_the_energy_that_implicit_euler_loses():
    """Amplitude after ten periods at 60 steps each: Euler's factor is (1 + w^2 h^2)^(-n/2) exactly."""
    steps, dt = 600, 2 * np.pi / FREQUENCY / 60
    lost = (1 + (FREQUENCY * dt) ** 2) ** (-steps / 2)
    x, v = oscillate(ImplicitEuler(), dt, steps)
    assert np.hypot(x, v / FREQUENCY) == pytest.approx(lost, rel=1e-9)
    x, v = oscillate(SDIRK2(), dt, steps)
    assert 0.97 < np.hypot(x, v / FREQUENCY) < 1


def test_times_of_the_stages():
    seen = []
    still = torch.zeros(1, 3, dtype=torch.float64)

    def solve(step, time):
        seen.append((time, step.dt))
        return step.target

    end = SDIRK2().advance(State(2.0, still, still + 1), 0.1, solve)
    gamma = 1 - 2**-0.5
    np.testing.assert_allclose(seen, [(2 + 0.1 * gamma, 0.1 * gamma), (2.1, 0.1 * gamma)])
    np.testing.assert_allclose(end.x, 0.1)
    np.testing.assert_allclose(end.v, 1.0)
