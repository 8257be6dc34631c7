"""What a model says where a measurement was taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement
from caphy.measure.finer import FinerMesh
from caphy.measure.noise import measurement_noise
from caphy.measure.scene import Scene
from caphy.measure.windows import LENGTH, SUBSTEPS, TOLERANCE, StartStates, WindowRun, across, roll_out, window_starts
from caphy.solve.integrators import State
from caphy.solve.rollout import Simulator

FINER = 4
"""How many times finer the steps are by which the error of the time step is told."""
CHECKED = 3
"""Windows in which the errors of the time step, of the mesh and of the restarts are told."""
FOLD = 6
"""Times as long a roll-out takes on the finer mesh, about."""
RUN_UP = 3
"""Frames of the model's own motion that a restart looks back on."""

Progress = Callable[[str, int, int], None]
"""Told what is being done, how much of it is done, and of how much."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Model positions row by row; a row is one frame of the measurement.

    Errors of solver and restarts are told as the model is measured: of clouds, across the cloth.

    Attributes:
        frames: frame of each row, rising, (N,).
        vertices: (N, V, 3) [m].
        faces: (F, 3).
        registered: the vertices are those of the measurement, so that vertex errors mean something.
        lag: frames since the model was last started from the measurement (N,); none where it ran freely.
        window: which restart each row belongs to, (N,).
        converged: whether the solver converged (N,).
        step_error: how far vertices move when the time step is made finer, (N, V) [m], as much of it as the
            measurement shows; NaN where not tried.
        mesh_error: how far they move when edges are half as long, likewise.
        start_error: how far vertices move when the model's own motion, with the measurement's noise added, is what it
            is restarted from, (N, V) [m]; NaN where not tried. A perfect model would still be that far off.
        material: flat rest shape of each face (F, 3, 2) [m], or none.
        body_vertices, body_faces: the body in each row (N, B, 3) [m] and its triangles, or none.
        cautions: what must be said beside the figures.
    """

    frames: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    registered: bool
    lag: np.ndarray | None
    window: np.ndarray
    converged: np.ndarray
    step_error: np.ndarray | None = None
    mesh_error: np.ndarray | None = None
    start_error: np.ndarray | None = None
    material: np.ndarray | None = None
    body_vertices: np.ndarray | None = None
    body_faces: np.ndarray | None = None
    cautions: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Window:
    """The frames of one window without its start, which is made from the measurement.

    Attributes:
        frames: (n,).
        positions: (n, V, 3) [m].
        converged: (n,).
        step_error, mesh_error, start_error: (n, V) [m], as of :class:`Prediction`.
    """

    frames: np.ndarray
    positions: np.ndarray
    converged: np.ndarray
    step_error: np.ndarray
    mesh_error: np.ndarray
    start_error: np.ndarray


class Windows:
    """A measurement in windows that follow one another, in each of which a model is rolled out.

    Attributes:
        frames: at which they start.
        checked: those in which what is not the model's is told as well.
    """

    def __init__(self, scene: Scene, model: Model, length: int = LENGTH) -> None:
        """Raises :class:`CaphyError` where no window can start."""
        self.scene, self._length = scene, length
        self._potential = scene.potential(model)
        self._starts = StartStates(scene, self._potential)
        self.frames = window_starts(self._starts, length)
        if not self.frames:
            where = scene.measurement.source or scene.measurement.name
            raise CaphyError(
                f"{where}: no window can start: that takes three frames in a row around which half of the vertices "
                f"were seen; {len(scene.measurement.seen_frames)} of {len(scene.measurement)} frames show anything"
            )
        spread = np.linspace(0, len(self.frames) - 1, min(CHECKED, len(self.frames)))
        self.checked = frozenset(self.frames[i] for i in spread.astype(int))
        self._model = model

    @cached_property  # not made where other processes roll out
    def _simulator(self) -> Simulator:
        return self.scene.simulator(self._potential, TOLERANCE)

    @cached_property
    def _finer(self) -> tuple[FinerMesh, Simulator]:
        finer = FinerMesh(self.scene)
        return finer, finer.scene.simulator(finer.scene.potential(self._model), TOLERANCE)

    @cached_property
    def _sigma(self) -> float:
        noise = measurement_noise(self.scene.measurement)
        return 0.0 if noise is None else noise.sigma

    def work(self, frame: int) -> int:
        """What a window takes, in roll-outs."""
        return 1 + (frame in self.checked) * (FINER + FOLD + 2)

    def told(self, frame: int) -> Window:
        """The window that starts at a frame; it ends where the next one starts, so that no frame is told twice."""
        later = next((other for other in self.frames if other > frame), frame + self._length)
        until = min(self._length, later - frame)
        state = self._starts.state(frame)
        run = roll_out(self.scene, self._simulator, state, frame, length=until)
        errors = np.full((3, *run.positions.shape[:2]), np.nan)
        if frame in self.checked:
            slow = roll_out(self.scene, self._simulator, state, frame, length=until, substeps=FINER * SUBSTEPS)
            finer, fine = self._finer
            for place, moved in enumerate((slow.positions - run.positions, finer.difference(fine, state, run))):
                change = _measured(self.scene, run.positions, moved)
                errors[place] = _share_seen(self.scene.measurement, run, change) * np.linalg.norm(change, axis=-1)
            again = _restarted(self.scene, self._potential, self._simulator, state, frame, until, self._sigma)
            errors[2, : len(again)] = again
        return Window(run.frames[1:], run.positions[1:], run.converged[1:], *errors[:, 1:])


Spread = Callable[[Scene, Model, int, Sequence[int]], Iterator[Window]]
"""Rolls out the windows of a scene that start at some frames, of that length, in any order."""


def predict_in_windows(
    scene: Scene,
    model: Model,
    length: int = LENGTH,
    progress: Progress | None = None,
    spread: Spread | None = None,
) -> Prediction:
    """A physics model rolled out in windows that follow one another, each started from the measurement.

    In a few windows, spread over the measurement, three errors are told that are not the model's: that of the time
    step, by steps :data:`FINER` times finer, that of the mesh, by edges half as long, and that of the restarts,
    by restarting the model from its own noisy motion.

    Args:
        spread: rolls out the windows elsewhere; here, one after another, unless given.

    Raises:
        CaphyError: no window can be started, because too little was seen in neighbouring frames.
    """
    windows = Windows(scene, model, length)
    longest_first = sorted(windows.frames, key=windows.work, reverse=True)
    found = map(windows.told, longest_first) if spread is None else spread(scene, model, length, longest_first)
    work, done, told = sum(map(windows.work, windows.frames)), 0, {}
    for window in found:
        start = int(window.frames[0]) - 1
        told[start] = window
        done += windows.work(start)
        if progress is not None:
            progress("rolling out", done, work)
    return replace(_joined(scene, [told[frame] for frame in windows.frames]), cautions=_lacking(model))


def _lacking(model: Model) -> tuple[str, ...]:
    """What every cloth has and a model has not, in words."""
    missing = [name for name in ("inertia", "gravity") if name not in model.effects]
    return (f"the model has no {' and no '.join(missing)}; caphy effects show {missing[0]}",) if missing else ()


def _measured(scene: Scene, positions: np.ndarray, change: np.ndarray) -> np.ndarray:
    """What of a change (n, V, 3) [m] of a cloth at positions (n, V, 3) [m] is measured: of clouds the part across."""
    return across(change[:, None], positions, scene.garment.faces)[:, 0] if scene.slides else change


def _share_seen(measurement: Measurement, run: WindowRun, change: np.ndarray) -> float:
    """Least-squares amount in [0, 1] of what a finer step or mesh changes (n + 1, V, 3) in the errors of a window.

    None of the mesh's where the cloth is itself made of the model's triangles; little of the step's where cloth
    buckles, so that the finer step takes another way than the cloth did.
    """
    assert measurement.vertices is not None
    seen = measurement.observed[run.frames]
    away = (measurement.vertices[run.frames] - run.positions)[seen]
    return float(np.clip((away * change[seen]).sum() / max((change[seen] ** 2).sum(), 1e-300), 0, 1))


def _restarted(
    scene: Scene, potential: Potential, simulator: Simulator, state: State, frame: int, length: int, sigma: float
) -> np.ndarray:
    """How far a perfect model gets from itself (n + 1, V) [m] by being restarted from its own motion with noise."""
    truth = roll_out(scene, simulator, state, frame, length=length + RUN_UP)
    vertices = np.full((len(scene.measurement), len(scene.garment.vertices), 3), np.nan)
    random = np.random.default_rng(frame)
    vertices[truth.frames] = truth.positions + random.normal(0, sigma, truth.positions.shape)
    measurement = replace(
        scene.measurement,
        vertices=vertices,
        faces=scene.garment.faces,
        points=None,
        offsets=None,
        noise=None,
        visibility=scene.measurement.observed,  # holes stay holes, however they were told
    )
    starts = StartStates(replace(scene, measurement=measurement), potential)
    begin = frame + RUN_UP
    if not starts.possible(begin):
        return np.full((0, len(scene.garment.vertices)), np.nan)
    again = roll_out(scene, simulator, starts.state(begin), begin, length=length)
    true = truth.positions[RUN_UP : RUN_UP + len(again.positions)]
    return np.linalg.norm(_measured(scene, true, again.positions - true), axis=-1)


def _joined(scene: Scene, windows: Sequence[Window]) -> Prediction:
    """Windows as rows."""
    arrays: dict[str, Any] = {
        each.name: np.concatenate([getattr(w, each.name) for w in windows]) for each in fields(Window)
    }
    frames = arrays.pop("frames")
    return Prediction(
        frames=frames,
        vertices=arrays.pop("positions"),
        faces=scene.garment.faces,
        registered=scene.measurement.registered,
        lag=np.concatenate([np.arange(1, len(w.frames) + 1) for w in windows]),
        window=np.concatenate([np.full(len(w.frames), i) for i, w in enumerate(windows)]),
        material=scene.garment.material,
        body_vertices=scene.body_vertices(frames),
        body_faces=scene.body_faces,
        **arrays,
    )
