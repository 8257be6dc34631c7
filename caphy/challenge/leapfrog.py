"""Simulation of cloth by an explicit method with tiny steps: an integrator that has nothing in common with the solver.

Velocity Verlet in two rates (Tuckerman, Berne, Martyna, J. Chem. Phys. 97, 1992): stretch, contact and what else is
stiff act in steps as short as the mesh demands, all other effects in kicks at :data:`RATE`. It asks the effects only
for their gradients at the present positions, solves no equations and damps nothing by itself. Two laws too stiff for
that, friction and strain-rate damping, act at the end of each kick's interval, implicitly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caphy.challenge.planes import ContactPlanes, MovingBody
from caphy.challenge.rates import bending_rates, drift, slowed
from caphy.effects.base import BodyState, Effect, Step
from caphy.effects.cloth import Cloth
from caphy.effects.compiled import Arguments, Bound
from caphy.effects.model import Model
from caphy.effects.potential import Potential, Term, kernel_of
from caphy.errors import CaphyError
from caphy.solve.integrators import State

RATE = 960.0
"""Fewest kicks per second [Hz]: 16 times as many as the diagnosis takes steps."""
TURN = 0.4
"""Of the fastest motion that kicks alone would make, its angle from one to the next at most [rad].

Longer ones meet the stretching in between in resonance: at 0.55 shrunk cloth of 1.25 cm edges flew apart."""
RATE_ON_BODY = 7200.0
"""Fewest short steps per second in contact with a body, whose push is stiff [Hz].

At half of it a T-shirt of 2.2 cm edges flew apart while it was put on."""

FRICTION = "body_friction"
VISCOSITY = "viscous_damping"
BENDING = "bending_damping"

Force = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""Forces (V, 3) [N] at positions (V, 3) [m], velocities (V, 3) [m/s] and a time [s]."""


class FlewApart(CaphyError):
    """Steps were too long for how the cloth moved."""


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
    body: MovingBody | None = None
    ahead: float = 0.0


class Leapfrog:
    """Moves a cloth under a model, and under a force from outside the library where one is given."""

    def __init__(self, model: Model, cloth: Cloth, drive: Drive, force: Force | None = None) -> None:
        """The model's inertia is taken as masses; its gradient is never evaluated away from zero."""
        whole = Potential(model.without_effect("inertia"), cloth)
        self.drive, self.force, self.cloth = drive, force, whole.cloth
        mass = whole.cloth.mass[:, None] + _extra_mass(whole)
        if mass.min() <= 0:
            raise CaphyError("every vertex must keep a positive mass; make negative extra masses smaller")
        if drive.fixed is not None:
            mass[drive.fixed] = np.inf
        self.mass, self._inverse = mass, 1 / mass
        self.friction = _only(whole, lambda name, effect: name == FRICTION)
        self.viscosity = whole.terms.pop(VISCOSITY, None)
        self.slow = _only(whole, lambda name, effect: not _is_stiff(effect) and name != BENDING)
        self.fast = _only(whole, lambda name, effect: _is_stiff(effect) and name != FRICTION)
        self._slow_loops = list(_elastic_loops(self.slow))
        self._fast_loops = [*_elastic_loops(self.fast), *_damping_loops(whole)]
        self._loops_on_body = list(_loops_on_body(self.fast))
        self.rate, self.kick_rate = self._stable_rate(), self._kick_rate()

    def hurried(self, factor: float) -> Leapfrog:
        """The same with shorter steps, and more of them."""
        other = copy(self)
        other.rate, other.kick_rate = factor * self.rate, factor * self.kick_rate
        return other

    def run(self, state: State, frames: int, fps: float, calming: float = 0.0) -> list[State]:
        """The states at ``frames`` frames after one; ``calming`` [1/s] slows all motion, to come to rest."""
        kicks = int(np.ceil(self.kick_rate / fps))
        planes = ContactPlanes(self.drive.body, state.time + self.drive.ahead)
        now, states = _Now(state.x.numpy().copy(), state.v.numpy().copy(), state.time), []
        self._feel_slow(now, 1 / (kicks * fps), planes)
        self._feel_fast(now, 1 / (kicks * fps), planes)
        for frame in range(frames):
            with np.errstate(over="ignore", invalid="ignore"):  # told as cloth that flew apart
                for kick in range(kicks):
                    self._advance(now, state.time + frame / fps + (kick + 1) / (kicks * fps), planes)
                    now.v *= 1 - calming / (kicks * fps)
            x, v = torch.from_numpy(now.x.copy()), torch.from_numpy(now.v.copy())
            states.append(State(state.time + (frame + 1) / fps, x, v))
        return states

    def _advance(self, now: _Now, end: float, planes: ContactPlanes) -> None:
        """One kick's interval, up to a time ``end`` [s]."""
        span = end - now.time
        steps = int(np.ceil(self.rate * span))
        dt, path = span / steps, self._pin_path(now, end)
        now.v += 0.5 * span * self._inverse * now.slow
        for step in range(steps):
            near = drift(now.x, now.v, now.fast, self._inverse, dt if step else 0.5 * dt, dt)
            now.time += dt
            if not near:
                raise FlewApart(
                    f"the cloth flew apart at {now.time:.2f} s; {self.rate:.0f} steps per second are too few"
                )
            if self.drive.fixed is not None:
                now.x[self.drive.fixed], now.v[self.drive.fixed] = path(now.time)
            self._feel_fast(now, dt, planes)
        now.v += 0.5 * dt * self._inverse * now.fast
        now.time = end
        self._feel_slow(now, span, planes)
        now.v += 0.5 * span * self._inverse * now.slow
        self._soften(now, span, planes)

    def _pin_path(self, now: _Now, end: float) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
        """Positions and velocities (P, 3) of the pins from now to a time ``end`` [s], straight in between."""
        if self.drive.pins is None:
            return lambda time: (now.x[:0], now.v[:0])
        last = self.drive.pins(end)
        speed = (last - now.x[self.drive.fixed]) / (end - now.time)
        return lambda time: (last - (end - time) * speed, speed)

    def _feel_slow(self, now: _Now, span: float, planes: ContactPlanes) -> None:
        now.slow = self._gentle(now, span, self._body(now, planes))
        if self.force is not None:
            now.slow += self.force(now.x, now.v, now.time)

    def _feel_fast(self, now: _Now, dt: float, planes: ContactPlanes) -> None:
        now.fast = self._stiff(now, dt, self._body(now, planes))

    def _body(self, now: _Now, planes: ContactPlanes) -> BodyState | None:
        return planes.at(now.time + self.drive.ahead, now.x, now.v)

    def _gentle(self, now: _Now, span: float, body: BodyState | None) -> np.ndarray:
        """Force (V, 3) [N] of the effects that are not stiff."""
        return -_slope(now, self._slow_loops, self.slow, span, body)

    def _stiff(self, now: _Now, dt: float, body: BodyState | None) -> np.ndarray:
        """Force (V, 3) [N] of the stiff effects."""
        slope = _slope(now, self._fast_loops, self.fast, dt, body)
        if body is not None:
            for loop in self._loops_on_body:
                loop(now.x, body, slope)
        return -slope

    def _soften(self, now: _Now, span: float, planes: ContactPlanes) -> None:
        """Strain-rate damping and friction over a time [s], implicitly."""
        if self.viscosity is not None:
            viscosity = span * float(self.viscosity.values["viscosity"]) * self.cloth.face_area
            now.v = slowed(now.x, now.v, self.cloth.faces, self.cloth.face_inverse, viscosity, self.mass[:, 0])
        body = self._body(now, planes)
        if self.friction.terms and body is not None:
            now.v += span * self._inverse * self._friction(now, span, body)

    def _friction(self, now: _Now, span: float, body: BodyState) -> np.ndarray:
        """Friction force (V, 3) [N] that slows the slide over the body and never turns it round.

        Of a force g against a slide u an explicit step takes dt g / m; here u becomes u / (1 + dt |g| / (m |u|)).
        """
        force = -self.friction.gradient(torch.from_numpy(now.x), explicit_step(now, span), body)[1].numpy()
        relative, normal = now.v - body.velocity.numpy(), body.normal.numpy()
        slide = relative - (relative * normal).sum(-1, keepdims=True) * normal
        size, speed = (np.linalg.norm(field, axis=-1, keepdims=True) for field in (force, slide))
        return force / (1 + span * self._inverse * size / (speed + 1e-12))

    def _stable_rate(self, rounds: int = 40) -> float:
        """Steps per second [Hz] that the stiff effects demand of the cloth at rest, stretched by 10 %.

        Power iteration on the slope of their force, damping included; the scheme is stable up to dt^2 lambda = 4.
        """
        rate = RATE if self.drive.body is None else RATE_ON_BODY
        while True:

            def stiff(x: np.ndarray, moved: np.ndarray, rate: float = rate) -> np.ndarray:
                return self._stiff(_Now(x, rate * moved, 0.0), 1 / rate, None)

            if self._steepest(stiff, rounds) < 2 * rate**2:
                return rate
            rate *= 1.25

    def _kick_rate(self, rounds: int = 40) -> float:
        """Kicks per second [Hz] that all effects between them demand at rest, without what a body does."""

        def slow(x: np.ndarray, moved: np.ndarray) -> np.ndarray:
            return self._gentle(_Now(x, 0 * moved, 0.0), 1 / RATE, None)

        return max(RATE, np.sqrt(self._steepest(slow, rounds)) / TURN)

    def _steepest(self, force: Callable[[np.ndarray, np.ndarray], np.ndarray], rounds: int) -> float:
        """The largest slope of a force over mass [1/s^2], by power iteration at rest and stretched by 10 %.

        ``force`` (V, 3) [N] is told positions (V, 3) [m], and how far from rest they are.
        """
        rest, tiny = 1.1 * self.cloth.vertices, 1e-7
        direction, steepest = np.random.default_rng(0).normal(size=rest.shape), 0.0
        at_rest = force(rest, 0 * rest)
        for _ in range(rounds):
            moved = tiny * direction / max(float(np.linalg.norm(direction)), 1e-300)
            direction = (force(rest + moved, moved) - at_rest) * self._inverse / tiny
            steepest = float(np.linalg.norm(direction))
        return steepest


@dataclass(eq=False)
class _Now:
    """Positions and velocities (V, 3) at a time, and the forces (V, 3) [N] they call forth."""

    x: np.ndarray
    v: np.ndarray
    time: float
    slow: np.ndarray = field(default_factory=lambda: np.zeros(0))
    fast: np.ndarray = field(default_factory=lambda: np.zeros(0))


Loop = Callable[[np.ndarray, np.ndarray, np.ndarray], None]
"""Adds to a gradient (V, 3) [N] what positions (V, 3) and velocities (V, 3) call forth."""


def _slope(now: _Now, loops: Sequence[Loop], others: Potential, dt: float, body: BodyState | None) -> np.ndarray:
    """Gradient (V, 3) [N] of compiled effects and of the others, in a step of ``dt`` seconds."""
    slope = np.zeros_like(now.x)
    for loop in loops:
        loop(now.x, now.v, slope)
    if others.terms:
        slope += others.gradient(torch.from_numpy(now.x), explicit_step(now, dt), body)[1].numpy()
    return slope


def _elastic_loops(potential: Potential) -> Iterator[Loop]:
    """The compiled effects of a potential that need neither history nor body, taken out of it."""
    for name, term in list(potential.terms.items()):
        bind = kernel_of(type(term.effect))
        if bind is None or term.effect.needs_step or term.effect.needs_body:
            continue
        kernel, _, constants = _bound(bind, term, None)
        del potential.terms[name]
        yield lambda x, v, slope, kernel=kernel, constants=constants: kernel(
            x[None], *constants, np.zeros(1), slope[None]
        )


def _loops_on_body(potential: Potential) -> Iterator[Callable[[np.ndarray, BodyState, np.ndarray], None]]:
    """The compiled effects of a potential that need the body and no history, taken out of it."""
    anywhere = BodyState(*torch.zeros((4, 1, 3), dtype=torch.float64))
    for name, term in list(potential.terms.items()):
        bind = kernel_of(type(term.effect))
        if bind is None or term.effect.needs_step or not term.effect.needs_body:
            continue
        kernel, fields, constants = _bound(bind, term, anywhere)
        read = [each for field in fields for each, value in vars(anywhere).items() if value is field]
        del potential.terms[name]
        yield lambda x, body, slope, kernel=kernel, read=read, constants=constants: kernel(
            x[None], *(getattr(body, each).numpy()[None] for each in read), *constants, np.zeros(1), slope[None]
        )


def _bound(
    bind: Callable[[Bound], Arguments | None], term: Term, body: BodyState | None
) -> tuple[Callable, tuple[Tensor, ...], list[Any]]:
    """A kernel, the fields that it reads, and its constants."""
    arguments = bind(Bound(term.index, term.rest, term.values, None, body))
    assert arguments is not None, "without history every kernel holds"
    kernel, fields, given = arguments
    return kernel, fields, [value.contiguous().numpy() if isinstance(value, Tensor) else value for value in given]


def _damping_loops(potential: Potential) -> Iterator[Loop]:
    """Bending damping, from the velocities themselves."""
    if (term := potential.terms.get(BENDING)) is not None:
        viscosity = (term.values["viscosity"] * term.rest["length"] ** 2 / (8 * term.rest["area"])).numpy()
        hinges = potential.cloth.hinges
        yield lambda x, v, slope: bending_rates(x, v, hinges, viscosity, slope)


def explicit_step(now: _Now, dt: float) -> Step:
    """The step in which effects see the present positions and velocities, and no inertial force."""
    x, v = torch.from_numpy(now.x), torch.from_numpy(now.v)
    return Step(dt, x - dt * v, x, x - dt * v, v, now.time)


def _is_stiff(effect: Effect) -> bool:
    membrane = effect.element in ("face", "edge") and effect.group in ("stiffness", "rest shape", "damping")
    return membrane or effect.group == "contact"


def _only(potential: Potential, wanted: Callable[[str, Effect], bool]) -> Potential:
    """A potential with some of another's terms."""
    part = copy(potential)
    part.terms = {name: term for name, term in potential.terms.items() if wanted(name, term.effect)}
    return part


def _extra_mass(potential: Potential) -> np.ndarray:
    """Inertia (V, 1) [kg] of the effects of mass: dt^2 times the curvature of their energies."""
    rest = potential.cloth.vertices
    now, mass = _Now(rest, 0 * rest, 0.0), np.zeros((len(rest), 1))
    for term in potential.terms.values():
        if term.effect.group == "mass":
            elements = potential.elements(term, torch.from_numpy(rest), explicit_step(now, 1.0), None)
            mass[:, 0] += term.scatter(term.effect.hessian(elements, term.values)[:, 0, 0, 0]).numpy()
    return mass
