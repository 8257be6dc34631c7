"""Simulation of cloth by an explicit method with tiny steps: an integrator that has nothing in common with the solver.

The leapfrog scheme (Stoermer 1907, Verlet 1967), v += dt f(x, v) / m, x += dt v, asks the potential only for its
gradient at the present positions. It solves no equations and damps nothing by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caphy.challenge.planes import ContactPlanes
from caphy.challenge.rates import bending_rates, strain_rates
from caphy.effects.base import BodyState, Step
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential, Term
from caphy.errors import CaphyError
from caphy.measure.mesh_body import MeshBody
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import State

RATE = 1440.0
"""Steps per second where nothing demands more [Hz]: 24 times as many as the diagnosis takes."""
RATE_ON_BODY = 3600.0
"""The same in contact with a body, whose push is stiff [Hz]."""

FRICTION = "body_friction"

Force = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""Forces (V, 3) [N] at positions (V, 3) [m], velocities (V, 3) [m/s] and a time [s]."""


@dataclass(frozen=True, eq=False)
class Drive:
    """What holds and moves the cloth.

    Attributes:
        fixed: which vertices are pinned (V,), or none.
        pins: positions (P, 3) [m] of the pinned vertices at a time [s].
        body: the body, or none.
        ahead: how much later it is by the body's own clock [s].
    """

    fixed: np.ndarray | None = None
    pins: Callable[[float], np.ndarray] | None = None
    body: BodyMotion | MeshBody | None = None
    ahead: float = 0.0


class Leapfrog:
    """Moves a cloth under a model, and under a force from outside the library where one is given."""

    def __init__(self, model: Model, cloth: Cloth, drive: Drive, force: Force | None = None) -> None:
        """The model's inertia is taken as masses; its gradient is never evaluated away from zero."""
        self.potential = Potential(model.without_effect("inertia"), cloth)
        self.friction = self.potential.terms.pop(FRICTION, None)
        self._rates = tuple(_rates(self.potential))
        self.drive, self.force = drive, force
        self.pinned = None if drive.fixed is None else torch.from_numpy(np.flatnonzero(drive.fixed))
        self.mass = torch.as_tensor(self.potential.cloth.mass)[:, None] + self._extra_mass()
        if float(self.mass.min()) <= 0:
            raise CaphyError("every vertex must keep a positive mass; make negative extra masses smaller")
        self.rate = self._stable_rate()

    def run(self, state: State, frames: int, fps: float, calming: float = 0.0) -> list[State]:
        """The states at ``frames`` frames after one; ``calming`` [1/s] slows all motion, to come to rest."""
        steps = int(np.ceil(self.rate / fps))
        dt, seen = 1 / (fps * steps), ContactPlanes(self.drive.body, state.time + self.drive.ahead)
        x, v, states = state.x.clone(), state.v.clone(), []
        for frame in range(frames):
            for step in range(steps):
                time = state.time + (frame * steps + step) * dt
                v += (dt / self.mass) * self._forces(x, v, time, dt, seen.at(time + self.drive.ahead, x, v))
                v *= 1 - calming * dt
                x += dt * v
                self._pin(x, v, time, dt)
            if not bool(x.isfinite().all()):
                raise CaphyError(f"the cloth flew apart at {time:.2f} s; {self.rate:.0f} steps per second are too few")
            states.append(State(state.time + (frame + 1) / fps, x.clone(), v.clone()))
        return states

    def _forces(self, x: Tensor, v: Tensor, time: float, dt: float, body: BodyState | None) -> Tensor:
        step = explicit_step(x, v, dt, time)
        force = self._library(x, v, step, body)
        if self.force is not None:
            force += torch.from_numpy(self.force(x.numpy(), v.numpy(), time))
        if self.friction is not None and body is not None:
            force += self._friction(self.friction, v + dt * force / self.mass, x, dt, time, body)
        return force

    def _library(self, x: Tensor, v: Tensor, step: Step, body: BodyState | None) -> Tensor:
        """Force (V, 3) [N] of the model but for friction."""
        force = -self.potential.gradient(x, step, body)[1]
        for rate, constants in self._rates:
            rate(x.numpy(), v.numpy(), *constants, force.numpy())
        return force

    def _friction(self, term: Term, v: Tensor, x: Tensor, dt: float, time: float, body: BodyState) -> Tensor:
        """Friction force (V, 3) [N] that slows the slide of velocities v and never turns it round.

        Of a force g against a slide u an explicit step takes dt g / m; here u becomes u / (1 + dt |g| / (m |u|)).
        """
        elements = self.potential.elements(term, x, explicit_step(x, v, dt, time), body)
        force = -term.scatter(term.effect.gradient(elements, term.values)[1]).movedim(0, -1)
        relative = v - body.velocity
        slide = relative - (relative * body.normal).sum(-1, keepdim=True) * body.normal
        share = dt * force.norm(dim=-1, keepdim=True) / (self.mass * slide.norm(dim=-1, keepdim=True).clamp_min(1e-12))
        return force / (1 + share)

    def _pin(self, x: Tensor, v: Tensor, time: float, dt: float) -> None:
        if self.pinned is not None:
            assert self.drive.pins is not None
            place = torch.from_numpy(self.drive.pins(time + dt))
            v[self.pinned] += (place - x[self.pinned]) / dt
            x[self.pinned] = place

    def _extra_mass(self) -> Tensor:
        """Inertia (V, 1) [kg] of the effects of mass: dt^2 times the curvature of their energies."""
        x = torch.as_tensor(self.potential.cloth.vertices, dtype=torch.float64)
        mass, step = torch.zeros(len(x), 1, dtype=torch.float64), explicit_step(x, 0 * x, 1.0, 0.0)
        for term in self.potential.terms.values():
            if term.effect.group == "mass":
                elements = self.potential.elements(term, x, step, None)
                mass += term.scatter(term.effect.hessian(elements, term.values)[:, 0, 0, 0])[:, None]
        return mass

    def _stable_rate(self, rounds: int = 40) -> float:
        """Steps per second [Hz] at which the fastest mode of the cloth at rest, stretched by 10 %, stays calm.

        Power iteration on the gradient's slope, damping included; the scheme is stable up to dt^2 lambda = 4.
        """
        rest = 1.1 * torch.as_tensor(self.potential.cloth.vertices, dtype=torch.float64)
        random = torch.randn(rest.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        rate, tiny = RATE if self.drive.body is None else RATE_ON_BODY, 1e-7
        at_rest = self._library(rest, 0 * rest, explicit_step(rest, 0 * rest, 1 / rate, 0.0), None)
        while True:
            direction, fastest = random, 0.0
            for _ in range(rounds):
                direction = direction / direction.norm()
                moved, speed = rest + tiny * direction, rate * tiny * direction
                there = self._library(moved, speed, explicit_step(moved, speed, 1 / rate, 0.0), None)
                direction = (there - at_rest) / (tiny * self.mass)
                fastest = float(direction.norm())
            if fastest < 2 * rate**2:
                return rate
            rate *= 1.25


def _rates(potential: Potential) -> Iterator[tuple[Callable, tuple]]:
    """Internal damping, taken out of a potential: a loop over elements and its constants."""
    cloth, terms = potential.cloth, potential.terms
    if (term := terms.pop("bending_damping", None)) is not None:
        scale = term.rest["length"] ** 2 / (8 * term.rest["area"])
        yield bending_rates, (cloth.hinges, (term.values["viscosity"] * scale).numpy())
    if (term := terms.pop("viscous_damping", None)) is not None:
        yield strain_rates, (cloth.faces, cloth.face_inverse, float(term.values["viscosity"]) * cloth.face_area)


def explicit_step(x: Tensor, v: Tensor, dt: float, time: float) -> Step:
    """The step in which effects see positions x (V, 3) and velocities v (V, 3), and no inertial force."""
    return Step(dt, x - dt * v, x, x - dt * v, v, time)
