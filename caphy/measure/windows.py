"""Restarted windows: short roll-outs of the solver, each started from the measurement.

Free runs diverge for reasons that say nothing of the physics (a fold snaps a frame earlier); a few frames from a
measured start do not. The start must be free of noise, or the stiff membrane answers the noise: positions come from a
static balance of the model's own elasticity, weight and contact with the measured acceleration, held to the measured
positions by weak springs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Step, Values
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential, Term
from caphy.effects.vectors import dot, isotropic
from caphy.errors import CaphyError
from caphy.measure.local_fit import local_quadratic
from caphy.measure.scene import Scene
from caphy.report.render import vertex_normals
from caphy.solve.integrators import State
from caphy.solve.newton import Newton
from caphy.solve.rollout import Simulator

LENGTH = 8
"""Frames of a window."""
HOLD = 12_000.0
"""Stiffness over inertial mass of the springs that hold a start to the measured positions [1/s^2], on every mesh.

3 N/m on a vertex of 0.25 g. Modes of the cloth faster than sqrt(12,000) / 2 pi = 17 Hz are balanced, which frees them
of noise; slower ones follow the data."""
SUBSTEPS = 2
"""Steps of the integrator per frame."""
TOLERANCE = 5e-5
"""Of the solver [N]."""

AIR = ("drag", "wind", "external")
"""Groups of the effects whose forces are smooth over the cloth, so that noise in velocities hardly changes them."""

_LEAST_SEEN = 0.5  # share of the vertices that must be known for a window to start at a frame


class HeldToData(Effect):
    """Springs to measured positions and the inertial force of a measured acceleration.

    E = lambda/2 |x - P|^2 + (M a - f).x [J] per vertex, M a as of :func:`inertial_force` and f of :func:`air_force`;
    vertices that were not seen have lambda = 0. Not registered: it is no physics, it starts windows.
    """

    name = "held_to_data"
    element = "vertex"
    reference = "Gauss 1829 (least constraint), with the measured acceleration; Tikhonov term against noise"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        zeros = np.zeros((3, len(cloth.vertices)))
        return {"hold": zeros[0], "place": zeros, "push": zeros}

    def energy(self, e: Elements, p: Values) -> Tensor:
        (x,) = e.x
        offset = x - e.rest["place"]
        return 0.5 * e.rest["hold"] * dot(offset, offset) + dot(e.rest["push"], x)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        force = e.rest["hold"] * (e.x - e.rest["place"]) + e.rest["push"]
        return self.energy(e, p), force

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Constant and positive semi-definite."""
        return isotropic(e.rest["hold"], e.x)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)


def inertial_force(potential: Potential, acceleration: np.ndarray) -> np.ndarray:
    """Force (V, 3) [N] that accelerations (V, 3) [m/s^2] of the cloth ask for: of its mass and of the model's effects
    of mass (extra mass, heavy hems, air that moves along)."""
    x = torch.from_numpy(potential.cloth.vertices)
    still = torch.zeros_like(x)
    # In a step of 1 s inertia pulls to its target by M (x - target): the slope of the target is the mass, weight is not
    here, behind = (Step(1.0, x, target, x, still) for target in (x, x - torch.from_numpy(acceleration)))
    force = potential.cloth.mass[:, None] * acceleration
    for name, term in potential.terms.items():
        if term.effect.group == "mass" and name != "inertia" and not term.effect.needs_body:
            pulled, resting = (potential.term_gradient(name, x, step, None) for step in (behind, here))
            force = force + (pulled - resting).numpy()
    return force


def air_force(potential: Potential, x: np.ndarray, velocity: np.ndarray, time: float) -> np.ndarray:
    """Force (V, 3) [N] of drag, wind and pressure on cloth at x (V, 3) [m] that moves with velocities (V, 3) [m/s].

    Statics knows none of them, and without them cloth that rests in a wind would start half a millimetre off.
    """
    now, moved = torch.from_numpy(x), torch.from_numpy(velocity)
    step = Step(1.0, now - moved, now, now, moved, time)
    force = np.zeros_like(x)
    for name, term in potential.terms.items():
        if term.effect.group in AIR and term.effect.needs_step and not term.effect.needs_body:
            force -= potential.term_gradient(name, now, step, None).numpy()
    return force


def _held(potential: Potential) -> Potential:
    """A copy of a potential with :class:`HeldToData` added, to be filled in per frame."""
    held = Potential(potential.model, potential.cloth)
    effect, template = HeldToData(), Potential(Model(potential.cloth.density, {"gravity": {}}), potential.cloth)
    vertex = template.terms["gravity"]
    rest = {name: torch.from_numpy(value) for name, value in effect.rest(potential.cloth).items()}
    held.terms[effect.name] = Term(effect, vertex.index, vertex.incidence, rest, {})
    return held


class StartStates:
    """Positions and velocities of the cloth at measured frames, as the model could have produced them."""

    def __init__(self, scene: Scene, potential: Potential, hold: float = HOLD) -> None:
        """``hold`` is lambda per inertial mass [1/s^2]. Raises :class:`CaphyError` for clouds: register them first."""
        if scene.measurement.vertices is None:
            where = scene.measurement.source or scene.measurement.name
            raise CaphyError(f"{where}: windows start from registered vertices, not from point clouds")
        self.scene, self.hold = scene, hold
        self.cloth = potential.cloth
        self._held = _held(potential)
        self._newton = Newton(self._held, scene.fixed, TOLERANCE).resolving()
        self._mass = inertial_force(potential, np.ones_like(self.cloth.vertices)).mean(axis=1).clip(min=0)
        self._solved: dict[int, np.ndarray] = {}

    def possible(self, frame: int) -> bool:
        """Whether enough was seen around a frame and its neighbours."""
        if not 1 <= frame < len(self.scene.measurement) - 1:
            return False
        return all(self._fit(f).known.mean() >= _LEAST_SEEN for f in (frame - 1, frame, frame + 1))

    def positions(self, frame: int) -> np.ndarray:
        """The balanced positions (V, 3) [m] at a frame."""
        if frame not in self._solved:
            self._solved[frame] = self._balance(frame)
        return self._solved[frame]

    def state(self, frame: int) -> State:
        """The state at a frame; velocities are central differences of balanced positions."""
        fps = self.scene.measurement.fps
        velocity = (self.positions(frame + 1) - self.positions(frame - 1)) * (0.5 * fps)
        return State(frame / fps, torch.from_numpy(self.positions(frame).copy()), torch.from_numpy(velocity))

    def _fit(self, frame: int):
        measurement = self.scene.measurement
        assert measurement.vertices is not None
        return local_quadratic(measurement.vertices, measurement.observed, measurement.fps, frame)

    def _balance(self, frame: int) -> np.ndarray:
        """argmin of elasticity + weight + contact + (M a - air).x + lambda/2 |x - P|^2 at a frame."""
        fit, time, cloth = self._fit(frame), frame / self.scene.measurement.fps, self.cloth
        place = filled(fit.position, fit.known, cloth)
        push = inertial_force(self._held, filled(fit.acceleration, fit.known, cloth))
        push = push - air_force(self._held, place, filled(fit.velocity, fit.known, cloth), time)
        rest = self._held.terms[HeldToData.name].rest
        rest["hold"] = torch.from_numpy(self.hold * self._mass * fit.known)
        rest["place"], rest["push"] = (torch.from_numpy(np.ascontiguousarray(a.T)) for a in (place, push))
        guess = torch.from_numpy(place.copy())
        if self.scene.pins is not None and self.scene.fixed is not None:
            guess[torch.from_numpy(np.flatnonzero(self.scene.fixed))] = self.scene.pins(time)
        motion = self.scene.motion
        body = None if motion is None else lambda x: motion.state(time, x.numpy(), 1 / self.scene.measurement.fps)
        return self._newton.minimise(guess, None, body)[0].numpy()


def graph_laplacian(neighbours: np.ndarray, count: int):
    """The Laplacian (count, count) of pairs (E, 2), in rows; what has no known neighbour is drawn to zero, weakly."""
    from scipy.sparse import coo_array

    a, b = neighbours.T
    every = np.arange(count)
    degree = np.bincount(np.r_[a, b], minlength=count) + 1e-9
    entries = np.r_[-np.ones(2 * len(a)), degree]
    return coo_array((entries, (np.r_[a, b, every], np.r_[b, a, every])), (count, count)).tocsr()


def filled(field: np.ndarray, known: np.ndarray, cloth: Cloth) -> np.ndarray:
    """A vertex field (V, 3) whose unknown entries are the harmonic continuation of the known ones over the mesh."""
    if known.all():
        return field.copy()
    from scipy.sparse.linalg import spsolve

    rows, value = graph_laplacian(cloth.edges, len(known))[~known], field.copy()
    right = -(rows[:, known] @ field[known])
    value[~known] = np.asarray(spsolve(rows[:, ~known].tocsc(), right)).reshape(-1, 3)
    return value


@dataclass(frozen=True, eq=False)
class WindowRun:
    """One window rolled out.

    Attributes:
        start: frame it starts at.
        positions: (L + 1, V, 3) [m], the first being the start state.
        converged: whether all minimisations of each frame converged, (L + 1,).
    """

    start: int
    positions: np.ndarray
    converged: np.ndarray

    @property
    def frames(self) -> np.ndarray:
        """The frames of ``positions`` (L + 1,)."""
        return self.start + np.arange(len(self.positions))


def window_starts(starts: StartStates, length: int = LENGTH, stride: int | None = None) -> list[int]:
    """Frames at which windows of ``length`` frames can start, ``stride`` apart (by default one after another).

    Where holes forbid a start, the next possible frame is taken. Windows that would see no frame are left out.
    """
    count, stride = len(starts.scene.measurement), length if stride is None else stride
    chosen, frame = [], 1
    while frame < count - 1:
        if starts.possible(frame):
            chosen.append(frame)
            frame += stride
        else:
            frame += 1
    return chosen


def roll_out(
    scene: Scene, simulator: Simulator, state: State, frame: int, *, length: int = LENGTH, substeps: int = SUBSTEPS
) -> WindowRun:
    """Roll out for ``length`` frames, or to the measurement's end, from a state at ``frame``."""
    fps = scene.measurement.fps
    positions, converged = [state.x.numpy()], [True]
    for step in range(min(length, len(scene.measurement) - 1 - frame)):
        state, reports = simulator.advance(replace(state, time=(frame + step) / fps), 1 / fps, substeps)
        positions.append(state.x.numpy())
        converged.append(all(report.converged for report in reports))
    return WindowRun(frame, np.stack(positions), np.array(converged))


def across(fields: np.ndarray, positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The parts of fields (L, N, V, 3) across a cloth at positions (L, V, 3) [m].

    What lies along it a cloud does not show: the model that helped to register it put it there.
    """
    normal = np.stack([vertex_normals(x, faces) for x in positions])[:, None]
    return (fields * normal).sum(-1, keepdims=True) * normal
