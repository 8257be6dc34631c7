"""Time integration: every method is a sequence of incremental potentials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Protocol

from torch import Tensor

from caphy.effects.base import Step
from caphy.errors import CaphyError


@dataclass(frozen=True)
class State:
    """Positions x (V, 3) [m] and velocities v (V, 3) [m/s] of a garment at a time [s]."""

    time: float
    x: Tensor
    v: Tensor


Solve = Callable[[Step, float], Tensor]
"""The minimiser (V, 3) [m] of the potential of a step that ends at a time [s]."""


class Integrator(Protocol):
    """A method that advances a state by dt [s] through minimisations."""

    order: int

    def advance(self, state: State, dt: float, solve: Solve) -> State: ...


class ImplicitEuler:
    """Implicit Euler, what the network's loss minimises: first order, damps what swings at omega by omega^2 dt / 2."""

    order = 1

    def advance(self, state: State, dt: float, solve: Solve) -> State:
        """The state one step of ``dt`` seconds later."""
        time = state.time + dt
        x = solve(Step(dt, state.x, state.x + dt * state.v, state.x, state.v, time), time)
        return State(time, x, (x - state.x) / dt)


class SDIRK2:
    """Two-stage singly diagonally implicit Runge-Kutta method, second order, L-stable (Alexander, SINUM 14, 1977).

    First order where forces follow the shape of the state before (the normals of pressure, the places of a wind field).

    With gamma = 1 - 1/sqrt(2) the tableau is (gamma, 0 | 1 - gamma, gamma), whose last row is also the weights. For
    x' = v, v' = a(x, v) a stage of origin o = x + dt sum a_ij v_j and velocity b = v + dt sum a_ij a_j is
    implicit Euler with the step gamma dt: X = o + gamma dt V, V = b + gamma dt a(X, V), so its target is
    o + gamma dt b.
    """

    order = 2
    gamma = 1 - 1 / sqrt(2)

    def advance(self, state: State, dt: float, solve: Solve) -> State:
        """The state one step of ``dt`` seconds later."""
        h, rest = self.gamma * dt, (1 - self.gamma) * dt
        middle_time = state.time + h
        middle = solve(Step(h, state.x, state.x + h * state.v, state.x, state.v, middle_time), middle_time)
        middle_velocity = (middle - state.x) / h
        acceleration = (middle_velocity - state.v) / h
        origin = state.x + rest * middle_velocity
        velocity = state.v + rest * acceleration
        time = state.time + dt
        x = solve(Step(h, origin, origin + h * velocity, middle, middle_velocity, time, lead=rest / h), time)
        return State(time, x, (x - origin) / h)


INTEGRATORS: dict[str, type[ImplicitEuler] | type[SDIRK2]] = {"implicit-euler": ImplicitEuler, "sdirk2": SDIRK2}
"""Integrators by the name used on the command line."""


def find_integrator(name: str) -> Integrator:
    """The integrator of a name."""
    if name not in INTEGRATORS:
        raise CaphyError(f"there is no integrator {name!r}; known: {', '.join(INTEGRATORS)}")
    return INTEGRATORS[name]()
