"""Simulation of cloth by an explicit method with tiny steps: an integrator that has nothing in common with the solver.

Velocity Verlet in two rates (Tuckerman, Berne, Martyna, J. Chem. Phys. 97, 1992): stretch, contact and what else is
stiff act in steps as short as the mesh demands, all other effects in kicks at :data:`RATE`. It asks the effects only
for their gradients at the present positions, solves no equations and damps nothing by itself. Two laws too stiff for
that, friction and strain-rate damping, act at the end of each kick's interval, implicitly.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from caphy.challenge.planes import ContactPlanes
from caphy.challenge.rates import bending_rates, slowed
from caphy.effects.base import BodyState, Effect, Step
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.measure.mesh_body import MeshBody
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import State

RATE = 960.0
"""Kicks per second [Hz]: 16 times as many as the diagnosis takes steps."""
RATE_ON_BODY = 3600.0
"""Fewest short steps per second in contact with a body, whose push is stiff [Hz]."""

FRICTION = "body_friction"
VISCOSITY = "viscous_damping"

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
        whole = Potential(model.without_effect("inertia"), cloth)
        self.drive, self.force, self.cloth = drive, force, whole.cloth
        self.pinned = None if drive.fixed is None else torch.from_numpy(np.flatnonzero(drive.fixed))
        self.mass = torch.as_tensor(whole.cloth.mass)[:, None] + _extra_mass(whole)
        if float(self.mass.min()) <= 0:
            raise CaphyError("every vertex must keep a positive mass; make negative extra masses smaller")
        if self.pinned is not None:
            self.mass[self.pinned] = torch.inf
        self.friction = _only(whole, lambda name, effect: name == FRICTION)
        self.viscosity = whole.terms.pop(VISCOSITY, None)
        self.damping = whole.terms.pop("bending_damping", None)
        self.fast = _only(whole, lambda name, effect: _is_stiff(effect) and name != FRICTION)
        self.slow = _only(whole, lambda name, effect: not _is_stiff(effect))
        self.rate = self._stable_rate()

    def run(self, state: State, frames: int, fps: float, calming: float = 0.0) -> list[State]:
        """The states at ``frames`` frames after one; ``calming`` [1/s] slows all motion, to come to rest."""
        kicks = int(np.ceil(RATE / fps))
        planes = ContactPlanes(self.drive.body, state.time + self.drive.ahead)
        now, states = _Now(state.x.clone(), state.v.clone(), state.time), []
        self._feel(now, 1 / (kicks * fps), planes)
        for frame in range(frames):
            for kick in range(kicks):
                end = state.time + frame / fps + (kick + 1) / (kicks * fps)
                self._advance(now, end, planes)
                now.v *= 1 - calming / (kicks * fps)
            if not bool(now.x.isfinite().all()):
                raise CaphyError(f"the cloth flew apart at {end:.2f} s; {self.rate:.0f} steps per second are too few")
            states.append(State(state.time + (frame + 1) / fps, now.x.clone(), now.v.clone()))
        return states

    def _advance(self, now: _Now, end: float, planes: ContactPlanes) -> None:
        """One kick's interval, up to a time ``end`` [s]."""
        span = end - now.time
        steps = int(np.ceil(self.rate * span))
        dt, path = span / steps, self._pin_path(now, end)
        now.v += 0.5 * span / self.mass * now.slow
        for _ in range(steps):
            now.v += 0.5 * dt / self.mass * now.fast
            now.x += dt * now.v
            now.time += dt
            if self.pinned is not None:
                now.x[self.pinned], now.v[self.pinned] = path(now.time)
            self._feel_fast(now, dt, planes)
            now.v += 0.5 * dt / self.mass * now.fast
        now.time = end
        self._feel_slow(now, span, planes)
        now.v += 0.5 * span / self.mass * now.slow
        self._soften(now, span, planes)

    def _pin_path(self, now: _Now, end: float) -> Callable[[float], tuple[Tensor, Tensor]]:
        """Positions and velocities (P, 3) of the pins from now to a time ``end`` [s], straight in between."""
        if self.pinned is None:
            return lambda time: (now.x, now.v)
        assert self.drive.pins is not None
        last = torch.from_numpy(self.drive.pins(end))
        speed = (last - now.x[self.pinned]) / (end - now.time)
        return lambda time: (last - (end - time) * speed, speed)

    def _feel(self, now: _Now, span: float, planes: ContactPlanes) -> None:
        self._feel_slow(now, span, planes)
        self._feel_fast(now, span, planes)

    def _feel_slow(self, now: _Now, span: float, planes: ContactPlanes) -> None:
        body = planes.at(now.time + self.drive.ahead, now.x, now.v)
        now.slow = -self.slow.gradient(now.x, explicit_step(now, span), body)[1]
        if self.force is not None:
            now.slow += torch.from_numpy(self.force(now.x.numpy(), now.v.numpy(), now.time))

    def _feel_fast(self, now: _Now, dt: float, planes: ContactPlanes) -> None:
        now.fast = self._stiff(now, dt, planes.at(now.time + self.drive.ahead, now.x, now.v))

    def _stiff(self, now: _Now, dt: float, body: BodyState | None) -> Tensor:
        """Force (V, 3) [N] of the stiff effects."""
        force = -self.fast.gradient(now.x, explicit_step(now, dt), body)[1]
        if self.damping is not None:
            scale = self.damping.rest["length"] ** 2 / (8 * self.damping.rest["area"])
            viscosity = (self.damping.values["viscosity"] * scale).numpy()
            bending_rates(now.x.numpy(), now.v.numpy(), self.cloth.hinges, viscosity, force.numpy())
        return force

    def _soften(self, now: _Now, span: float, planes: ContactPlanes) -> None:
        """Strain-rate damping and friction over a time [s], implicitly."""
        if self.viscosity is not None:
            viscosity = float(self.viscosity.values["viscosity"]) * self.cloth.face_area
            constants = self.cloth.faces, self.cloth.face_inverse, span * viscosity, self.mass[:, 0].numpy()
            now.v = torch.from_numpy(slowed(now.x.numpy(), now.v.numpy(), *constants))
        body = planes.at(now.time + self.drive.ahead, now.x, now.v)
        if self.friction.terms and body is not None:
            now.v += span / self.mass * self._friction(now, span, body)

    def _friction(self, now: _Now, span: float, body: BodyState) -> Tensor:
        """Friction force (V, 3) [N] that slows the slide over the body and never turns it round.

        Of a force g against a slide u an explicit step takes dt g / m; here u becomes u / (1 + dt |g| / (m |u|)).
        """
        force = -self.friction.gradient(now.x, explicit_step(now, span), body)[1]
        relative = now.v - body.velocity
        slide = relative - (relative * body.normal).sum(-1, keepdim=True) * body.normal
        share = span * force.norm(dim=-1, keepdim=True) / (self.mass * (slide.norm(dim=-1, keepdim=True) + 1e-12))
        return force / (1 + share)

    def _stable_rate(self, rounds: int = 40) -> float:
        """Steps per second [Hz] that the stiff effects demand of the cloth at rest, stretched by 10 %.

        Power iteration on the slope of their force, damping included; the scheme is stable up to dt^2 lambda = 4.
        """
        rest = 1.1 * torch.as_tensor(self.cloth.vertices, dtype=torch.float64)
        random = torch.randn(rest.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        rate, tiny = RATE if self.drive.body is None else RATE_ON_BODY, 1e-7
        at_rest = self._stiff(_Now(rest, 0 * rest, 0.0), 1 / rate, None)
        while True:
            direction, fastest = random, 0.0
            for _ in range(rounds):
                moved = tiny * direction / direction.norm()
                there = self._stiff(_Now(rest + moved, rate * moved, 0.0), 1 / rate, None)
                direction = (there - at_rest) / (tiny * self.mass)
                fastest = float(direction.norm())
            if fastest < 2 * rate**2:
                return rate
            rate *= 1.25


@dataclass(eq=False)
class _Now:
    """Positions and velocities (V, 3) at a time, and the forces (V, 3) [N] they call forth."""

    x: Tensor
    v: Tensor
    time: float
    slow: Tensor = field(default_factory=lambda: torch.zeros(0))
    fast: Tensor = field(default_factory=lambda: torch.zeros(0))


def explicit_step(now: _Now, dt: float) -> Step:
    """The step in which effects see the present positions and velocities, and no inertial force."""
    origin = now.x - dt * now.v
    return Step(dt, origin, now.x, origin, now.v, now.time)


def _is_stiff(effect: Effect) -> bool:
    membrane = effect.element in ("face", "edge") and effect.group in ("stiffness", "rest shape", "damping")
    return membrane or effect.group == "contact"


def _only(potential: Potential, wanted: Callable[[str, Effect], bool]) -> Potential:
    """A potential with some of another's terms."""
    part = copy(potential)
    part.terms = {name: term for name, term in potential.terms.items() if wanted(name, term.effect)}
    return part


def _extra_mass(potential: Potential) -> Tensor:
    """Inertia (V, 1) [kg] of the effects of mass: dt^2 times the curvature of their energies."""
    x = torch.as_tensor(potential.cloth.vertices, dtype=torch.float64)
    mass, step = torch.zeros(len(x), 1, dtype=torch.float64), explicit_step(_Now(x, 0 * x, 0.0), 1.0)
    for term in potential.terms.values():
        if term.effect.group == "mass":
            elements = potential.elements(term, x, step, None)
            mass += term.scatter(term.effect.hessian(elements, term.values)[:, 0, 0, 0])[:, None]
    return mass
