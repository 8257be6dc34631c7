"""Simulation of a garment on a moving body with the reference solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Step
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.garment.template import write_npz
from caphy.kept import Kept
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import SDIRK2, Integrator, State
from caphy.solve.newton import Body, Curvature, Newton, Report

_GRIPS, _GRIPPED = 4, 1e-5
"""How often friction is told anew of the push that a step ends with, at most, and the change [m] below which it is that
one. Of 6,880 minima of cloth on pins with a ball 6,871 came so near, seven others within 0.11 mm."""
AT_ONCE = 20
"""Frames that are kept together, and lost together where a simulation is stopped."""
_SHRINKS = 0.9
"""Where a change is no smaller than this share of the one before it, a vertex is handed to and fro, as between arm and
trunk, and would be for ever (two of those 6,880, by 3 and 7 mm)."""


@dataclass(frozen=True)
class Trajectory:
    """A simulated motion.

    Attributes:
        positions: (T, V, 3) [m]; frame 0 is the state the simulation started from.
        velocities: (T, V, 3) [m/s].
        fps: frames per second [Hz].
        reports: of every minimisation, one tuple for each frame; of the first, of the last step that led there, empty
            where that is not known.
    """

    positions: np.ndarray
    velocities: np.ndarray
    fps: float
    reports: tuple[tuple[Report, ...], ...]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.positions)

    @property
    def converged(self) -> np.ndarray:
        """Whether every minimisation of each frame converged, (T,)."""
        return np.array([all(report.converged for report in frame) for frame in self.reports])

    @property
    def iterations(self) -> np.ndarray:
        """Newton iterations of each frame, (T,)."""
        return np.array([sum(report.iterations for report in frame) for frame in self.reports])

    @property
    def residual(self) -> np.ndarray:
        """Largest force left unbalanced in each frame (T,) [N]."""
        return np.array([max((report.residual for report in frame), default=0.0) for frame in self.reports])

    def save(self, path: str | Path) -> None:
        """Write an npz without pickles, atomically; positions and velocities as float32."""
        arrays = {
            "format": np.array("caphy-trajectory-1"),
            "positions": self.positions.astype(np.float32),
            "velocities": self.velocities.astype(np.float32),
            "fps": np.array(self.fps),
            "converged": self.converged,
            "iterations": self.iterations,
            "residual": self.residual,
        }
        write_npz(Path(path), arrays)


class Simulator:
    """Advances a garment in time by any integrator; each minimisation starts from cloth carried along by the body.

    Friction takes the push of the body from where the minimisation before it ended, in the same step, until they agree
    or nearly so (as in Incremental Potential Contact, Li et al., SIGGRAPH 2020). From the step before it would be the
    push of another stage: cloth that strikes a body lost 2.4 times as much speed along it as Coulomb's law says.
    """

    def __init__(
        self,
        newton: Newton,
        motion: BodyMotion | None = None,
        integrator: Integrator | None = None,
        pins: Callable[[float], Tensor] | None = None,
    ) -> None:
        """``pins`` gives the positions (P, 3) [m] of fixed vertices at a time [s]; without it they rest."""
        self.newton, self.motion, self.pins = newton, motion, pins
        self.integrator = SDIRK2() if integrator is None else integrator
        self._rubs = "body_friction" in newton.potential.terms
        self._pinned = None if newton.fixed is None else torch.from_numpy(np.flatnonzero(newton.fixed))

    def advance(self, state: State, dt: float, substeps: int = 1) -> tuple[State, tuple[Report, ...]]:
        """The state ``dt`` seconds later, in equal substeps, and the reports of all minimisations."""
        reports: list[Report] = []
        before, curvature = state.time, Curvature()

        def solve(step: Step, time: float) -> Tensor:
            nonlocal before
            guess = self._guess(step, before, time)
            motion, before = self.motion, time
            body = None if motion is None else lambda x: motion.state(time, x.numpy(), step.dt, float(step.lead))
            x, report = self.newton.minimise(guess, step, body, least=1, curvature=curvature)
            if self._rubs and body is not None:
                x, report = self._gripped(x, report, step, body, curvature)
            reports.append(report)
            return x

        for _ in range(substeps):
            state = self.integrator.advance(state, dt / substeps, solve)
        return state, tuple(reports)

    def _gripped(
        self, x: Tensor, report: Report, step: Step, body: Body, curvature: Curvature
    ) -> tuple[Tensor, Report]:
        """The minimiser whose friction goes by the push that it ends with itself, and all iterations on the way."""
        moved = np.inf
        for _ in range(_GRIPS):
            pressed, so_far, before = x, report.iterations, moved
            x, report = self.newton.minimise(pressed, replace(step, pressed=pressed), body, curvature=curvature)
            report = replace(report, iterations=so_far + report.iterations)
            moved = float((x - pressed).abs().max())
            if moved < _GRIPPED or moved > _SHRINKS * before:
                break
        return x, report

    def _guess(self, step: Step, before: float, time: float) -> Tensor:
        """Where the cloth would fly freely, or near the body be carried along by it, so that no limb overtakes it."""
        guess = step.target.clone()
        if self.motion is not None:
            guess = torch.from_numpy(self.motion.carried(step.lagged.numpy(), guess.numpy(), before, time))
        if self._pinned is not None:
            guess[self._pinned] = step.lagged[self._pinned] if self.pins is None else self.pins(time)
        return guess


def simulate(
    potential: Potential,
    motion: BodyMotion,
    start: State | None = None,
    integrator: Integrator | None = None,
    substeps: int = 1,
    tolerance: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    kept: Kept | None = None,
) -> Trajectory:
    """Simulate a garment through all frames of a motion.

    Args:
        potential: the physics, in float64 on the CPU.
        motion: the body and the garment on it.
        start: state at the first frame; without one :func:`caphy.solve.preroll.start_state` makes it.
        integrator: SDIRK2 unless given.
        substeps: steps per frame.
        tolerance: of the solver [N].
        progress: told the number of frames done and in total.
        kept: where every :data:`AT_ONCE` frames are kept, and found again by who simulates the same.

    Raises:
        CaphyError: the start or the garment does not fit, or its energy is not finite.
    """
    newton = Newton(potential) if tolerance is None else Newton(potential, tolerance=tolerance)
    kept = Kept() if kept is None else kept
    world = kept.key(potential.model, potential.cloth, motion.body, motion.betas, motion.garment, motion.poses)
    state = _started(kept, world, newton, motion) if start is None else start
    if state.x.shape != potential.cloth.vertices.shape:
        raise CaphyError(f"the start must have positions {potential.cloth.vertices.shape}, got {tuple(state.x.shape)}")
    simulator = Simulator(newton, motion, integrator)
    how = world, type(simulator.integrator).__name__, substeps, newton.tolerance
    states, reports = [state], []
    for first in range(1, len(motion), AT_ONCE):
        frames = range(first, min(first + AT_ONCE, len(motion)))
        key = kept.key("frames", how, first, len(frames), states[-1].x.numpy(), states[-1].v.numpy())
        if (found := kept.recall(key)) is not None:
            states += _states(found, frames, motion)
            reports += _reports(found)
        else:
            motion.forget()  # who goes on from here remembers nothing of what was before
            for frame in frames:
                last = State(motion.start + (frame - 1) / motion.fps, states[-1].x, states[-1].v)
                state, report = simulator.advance(last, 1 / motion.fps, substeps)
                states.append(state)
                reports.append(report)
                if progress is not None:
                    progress(frame + 1, len(motion))
            kept.keep(key, _arrays(states[first:], reports[first - 1 :]))
        if progress is not None:
            progress(frames.stop, len(motion))
    positions = torch.stack([state.x for state in states]).numpy()
    velocities = torch.stack([state.v for state in states]).numpy()
    return Trajectory(positions, velocities, motion.fps, ((), *reports))


def _started(kept: Kept, world: str, newton: Newton, motion: BodyMotion) -> State:
    """The start of a motion, as :func:`caphy.solve.preroll.start_state` makes it."""
    from caphy.solve.preroll import start_state

    key = kept.key("start", world, newton.tolerance)
    if (found := kept.recall(key)) is not None:
        return State(motion.start, torch.from_numpy(found["x"]), torch.from_numpy(found["v"]))
    state = start_state(newton, motion)
    kept.keep(key, {"x": state.x.numpy(), "v": state.v.numpy()})
    return state


def _arrays(states: Sequence[State], reports: Sequence[Sequence[Report]]) -> dict[str, np.ndarray]:
    """States (F) and reports (F, S), by name."""
    said = {each.name: np.array([[getattr(r, each.name) for r in one] for one in reports]) for each in fields(Report)}
    return {"x": np.stack([s.x.numpy() for s in states]), "v": np.stack([s.v.numpy() for s in states])} | said


def _states(arrays: dict[str, np.ndarray], frames: range, motion: BodyMotion) -> list[State]:
    x, v = (torch.from_numpy(arrays[name]) for name in "xv")
    return [State(motion.start + frame / motion.fps, *at) for frame, *at in zip(frames, x, v, strict=True)]


def _reports(arrays: dict[str, np.ndarray]) -> list[tuple[Report, ...]]:
    told = zip(*(arrays[each.name].tolist() for each in fields(Report)), strict=True)
    return [tuple(Report(*one) for one in zip(*frame, strict=True)) for frame in told]
