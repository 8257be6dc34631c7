"""Windows of a measurement against a model: what is left, and what every number of the model would do about it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.measure.scene import Scene
from caphy.measure.windows import LENGTH, SUBSTEPS, TOLERANCE, StartStates, WindowRun, roll_out, window_starts
from caphy.refit.columns import Column, extended
from caphy.refit.modes import Projection, laplacian_modes
from caphy.refit.tangents import Pushes, Start, Tangents, recorded_simulator
from caphy.solve.integrators import SDIRK2, State
from caphy.solve.newton import Newton
from caphy.solve.rollout import Simulator

START_MODES = 20
"""Modes in which a window's start may be wrong; each in three axes, in positions and in velocities."""
START_POSITION, START_VELOCITY = 0.3e-3, 0.015
"""How wrong, one standard deviation of each mode and axis: [m] and [m/s].

What windows ask for then has a mean square near one; with three times as much, starts leave the reach of tangents."""


@dataclass(frozen=True, eq=False)
class Response:
    """One window in the span of M smooth modes; L frames after its start.

    Attributes:
        scene, start: which measurement, and the frame it starts at.
        residual: measured minus predicted (L, M, 3) [m].
        seen: which frames were measured, (L,).
        columns: what one unit of each number changes (L, M, 3, K) [m].
        nuisance: what one standard deviation of each error that is not the model's changes (L, M, 3, N) [m]: of the
            time step, and of the start.
        offset: how far the start was moved from what the measurement alone says, in the nuisances' standard deviations
            (N,).
        error: distance of each vertex from its measured place (L, V) [m]; NaN where not seen.
        converged: whether the solver did, (L,).
    """

    scene: int
    start: int
    residual: np.ndarray
    seen: np.ndarray
    columns: np.ndarray
    nuisance: np.ndarray
    offset: np.ndarray
    error: np.ndarray
    converged: np.ndarray


class Watched:
    """A measured scene, cut into windows."""

    def __init__(self, scene: Scene, number: int = 0, length: int = LENGTH) -> None:
        if scene.measurement.vertices is None:
            where = scene.measurement.source or scene.measurement.name
            raise CaphyError(f"{where}: must be registered; register the point clouds first")
        self.scene, self.number, self.length = scene, number, length
        self._steps: dict[int, np.ndarray] = {}  # what the time step does, told once per window: models differ little

    @cached_property
    def projection(self) -> Projection:
        """Onto the modes of the scene's cloth."""
        cloth = self.scene.potential(Model(1.0)).cloth
        return Projection(laplacian_modes(cloth), cloth.vertex_area)

    def starts(self) -> list[int]:
        """Frames at which whole windows can start."""
        some = StartStates(self.scene, self.scene.potential(Model(1.0, {"gravity": {}})))
        last = len(self.scene.measurement) - 1
        return [frame for frame in window_starts(some, self.length) if frame + self.length <= last]

    def respond(
        self,
        model: Model,
        columns: Sequence[Column] | None,
        starts: Mapping[int, np.ndarray | None],
        pushes: Pushes | None = None,
    ) -> Iterator[Response]:
        """The windows that start at given frames, moved by given offsets (N,), one after another.

        ``pushes`` are further forces to respond to, after the columns. Without columns (None) nothing but the errors is
        told, at a fraction of the cost.
        """
        potential = self.scene.potential(model)
        newton = Newton(potential, self.scene.fixed, TOLERANCE)
        full = self.scene.potential(extended(model, columns or ()))
        tangents, states = Tangents(self.scene, newton, full, columns or (), pushes), StartStates(self.scene, potential)
        simulator, recorder = recorded_simulator(self.scene, newton, SDIRK2())
        coarse = Simulator(newton, self.scene.motion, pins=self.scene.pins)  # type: ignore[arg-type]
        errors = self._start()
        for frame, given in starts.items():
            recorder.stages.clear()
            offset = np.zeros(1 + len(errors.x)) if given is None else given.copy()
            offset[0] = 0  # the time step is what it is
            state = self._moved(states.state(frame), errors, offset[1:])
            run = roll_out(self.scene, simulator, state, frame, length=self.length)
            if columns is None:
                yield self._plain(frame, offset, run)
                continue
            moved = tangents.along(recorder.stages, errors, self.length, SUBSTEPS, SDIRK2())
            if frame not in self._steps:
                rough = roll_out(self.scene, coarse, state, frame, length=self.length, substeps=1)
                self._steps[frame] = (run.positions - rough.positions)[1:]
            yield self._response(frame, offset, run, moved[1:], self._steps[frame], moved.shape[1] - len(errors.x))

    def _moved(self, state: State, errors: Start, offset: np.ndarray) -> State:
        """A start state moved by an offset; pins stay where they are."""
        by = torch.from_numpy(offset)
        free = torch.ones(len(state.x)) if self.scene.fixed is None else torch.from_numpy(~self.scene.fixed)
        x, v = (torch.tensordot(by, field, 1) * free[:, None] for field in (errors.x, errors.v))
        return State(state.time, state.x + x, state.v + v)

    def _start(self) -> Start:
        """Errors of one standard deviation in each mode of the start's positions, then of its velocities."""
        modes = self.projection.modes[:, :START_MODES]
        fields = np.einsum("vm,ac->mavc", modes, np.eye(3)).reshape(-1, len(modes), 3)
        zero = np.zeros_like(fields)
        x, v = np.concatenate([START_POSITION * fields, zero]), np.concatenate([zero, START_VELOCITY * fields])
        return Start(torch.from_numpy(x), torch.from_numpy(v))

    def _plain(self, frame: int, offset: np.ndarray, run: WindowRun) -> Response:
        """The errors alone."""
        count = self.projection.modes.shape[1]
        nothing = np.zeros((self.length, 0, run.positions.shape[1], 3))
        step = np.zeros_like(run.positions[1:])
        response = self._response(frame, offset, run, nothing, step, 0)
        return replace(response, nuisance=np.zeros((self.length, count, 3, 0)))

    def _response(
        self, frame: int, offset: np.ndarray, run: WindowRun, moved: np.ndarray, step: np.ndarray, count: int
    ) -> Response:
        measurement = self.scene.measurement
        assert measurement.vertices is not None
        frames = run.frames[1:]
        away = measurement.vertices[frames] - run.positions[1:]
        seen = measurement.observed[frames]
        fields = np.concatenate([away[:, None], step[:, None], moved], axis=1)  # (L, 2 + K + N, V, 3)
        shape = (self.projection.modes.shape[1], 3, fields.shape[1])
        enough = seen.mean(axis=1) >= 0.5
        modal = np.stack(
            [
                self.projection.of(np.moveaxis(f, 0, -1), s) if good else np.zeros(shape)
                for f, s, good in zip(fields, seen, enough, strict=True)
            ]
        )
        error = np.where(seen, np.linalg.norm(away, axis=-1), np.nan)
        changes, starts = modal[..., 2 : 2 + count], modal[..., 2 + count :]
        nuisance = np.concatenate([modal[..., 1:2], starts], axis=-1)
        return Response(self.number, frame, modal[..., 0], enough, changes, nuisance, offset, error, run.converged[1:])


def watched(scenes: Sequence[Scene], length: int = LENGTH) -> list[Watched]:
    """Scenes in the order given."""
    return [Watched(scene, number, length) for number, scene in enumerate(scenes)]
