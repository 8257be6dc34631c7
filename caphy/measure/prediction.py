"""What a model says where a measurement was taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement
from caphy.measure.finer import FinerMesh
from caphy.measure.noise import measurement_noise
from caphy.measure.scene import Scene
from caphy.measure.windows import LENGTH, SUBSTEPS, TOLERANCE, StartStates, WindowRun, roll_out, window_starts
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

    Attributes:
        frames: frame of each row, rising, (N,).
        vertices: (N, V, 3) [m].
        faces: (F, 3).
        registered: the vertices are those of the measurement, so that vertex errors mean something.
        lag: frames since the model was last started from the measurement (N,); none where it ran freely.
        window: which restart each row belongs to, (N,).
        converged: whether the solver converged (N,).
        step_error: how far vertices move when the time step is made finer, (N, V) [m]; NaN where not tried.
        mesh_error: how far they move when edges are half as long, likewise; as much of it as the measurement shows.
        start_error: how far vertices move when the model's own motion, with the measurement's noise added, is what it
            is restarted from, (N, V) [m]; NaN where not tried. A perfect model would still be that far off.
        material: flat rest shape of each face (F, 3, 2) [m], or none.
        body_vertices, body_faces: the body in each row (N, B, 3) [m] and its triangles, or none.
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


def predict_in_windows(
    scene: Scene, model: Model, length: int = LENGTH, progress: Progress | None = None
) -> Prediction:
    """A physics model rolled out in windows that follow one another, each started from the measurement.

    In a few windows, spread over the measurement, three errors are told that are not the model's: that of the time
    step, by steps :data:`FINER` times finer, that of the mesh, by edges half as long, and that of the restarts,
    by restarting the model from its own noisy motion.

    Raises:
        CaphyError: no window can be started, because too little was seen in neighbouring frames.
    """
    potential = scene.potential(model)
    starts = StartStates(scene, potential)
    chosen = window_starts(starts, length)
    if not chosen:
        where = scene.measurement.source or scene.measurement.name
        raise CaphyError(
            f"{where}: no window can start: that takes three frames in a row around which half of the vertices were "
            f"seen; {len(scene.measurement.seen_frames)} of {len(scene.measurement)} frames show anything"
        )
    simulator, finer = scene.simulator(potential, TOLERANCE), FinerMesh(scene)
    fine = finer.scene.simulator(finer.scene.potential(model), TOLERANCE)
    noise = measurement_noise(scene.measurement)
    checked = {chosen[i] for i in np.linspace(0, len(chosen) - 1, min(CHECKED, len(chosen))).astype(int)}
    each = FINER + FOLD + 2
    work, done = len(chosen) + each * len(checked), 0
    runs, errors = [], []
    for number, frame in enumerate(chosen):
        # Up to the next start, so that no frame is predicted twice.
        until = min(length, chosen[number + 1] - frame if number + 1 < len(chosen) else length)
        state = starts.state(frame)
        run = roll_out(scene, simulator, state, frame, length=until)
        step_error, mesh_error, start_error = (np.full(run.positions.shape[:2], np.nan) for _ in range(3))
        if frame in checked:
            slow = roll_out(scene, simulator, state, frame, length=until, substeps=FINER * SUBSTEPS)
            step_error = np.linalg.norm(slow.positions - run.positions, axis=-1)
            by_mesh = finer.difference(fine, state, run)
            mesh_error = _share_seen(scene.measurement, run, by_mesh) * np.linalg.norm(by_mesh, axis=-1)
            sigma = 0.0 if noise is None else noise.sigma
            again = _restarted(scene, potential, simulator, state, frame, until, sigma)
            start_error[: len(again)] = again
            done += each
        done += 1
        runs.append(run)
        errors.append((step_error, mesh_error, start_error))
        if progress is not None:
            progress("rolling out", done, work)
    return _joined(scene, runs, *zip(*errors, strict=True))


def _share_seen(measurement: Measurement, run: WindowRun, by_mesh: np.ndarray) -> float:
    """Least-squares amount in [0, 1] of what a finer mesh changes (n + 1, V, 3) in the measured errors of a window.

    None of it where the cloth is itself made of the model's triangles.
    """
    assert measurement.vertices is not None
    seen = measurement.observed[run.frames]
    away = (measurement.vertices[run.frames] - run.positions)[seen]
    return float(np.clip((away * by_mesh[seen]).sum() / max((by_mesh[seen] ** 2).sum(), 1e-300), 0, 1))


def _restarted(
    scene: Scene, potential: Potential, simulator: Simulator, state: State, frame: int, length: int, sigma: float
) -> np.ndarray:
    """How far a perfect model gets from itself (n + 1, V) [m] by being restarted from its own motion with noise."""
    truth = roll_out(scene, simulator, state, frame, length=length + RUN_UP)
    vertices = np.full((len(scene.measurement), len(scene.garment.vertices), 3), np.nan)
    random = np.random.default_rng(frame)
    vertices[truth.frames] = truth.positions + random.normal(0, sigma, truth.positions.shape)
    measurement = replace(
        scene.measurement, vertices=vertices, faces=scene.garment.faces, points=None, offsets=None, noise=None
    )
    starts = StartStates(replace(scene, measurement=measurement), potential)
    begin = frame + RUN_UP
    if not starts.possible(begin):
        return np.full((0, len(scene.garment.vertices)), np.nan)
    again = roll_out(scene, simulator, starts.state(begin), begin, length=length)
    return np.linalg.norm(again.positions - truth.positions[RUN_UP : RUN_UP + len(again.positions)], axis=-1)


def _joined(
    scene: Scene,
    runs: Sequence[WindowRun],
    step_errors: Sequence[np.ndarray],
    mesh_errors: Sequence[np.ndarray],
    start_errors: Sequence[np.ndarray],
) -> Prediction:
    """Windows as rows. A window's own start is left out: it is made from the measurement."""
    frames = np.concatenate([run.frames[1:] for run in runs])
    return Prediction(
        frames=frames,
        vertices=np.concatenate([run.positions[1:] for run in runs]),
        faces=scene.garment.faces,
        registered=scene.measurement.registered,
        lag=np.concatenate([np.arange(1, len(run.positions)) for run in runs]),
        window=np.concatenate([np.full(len(run.positions) - 1, i) for i, run in enumerate(runs)]),
        converged=np.concatenate([run.converged[1:] for run in runs]),
        step_error=np.concatenate([error[1:] for error in step_errors]),
        mesh_error=np.concatenate([error[1:] for error in mesh_errors]),
        start_error=np.concatenate([error[1:] for error in start_errors]),
        material=scene.garment.material,
        body_vertices=scene.body_vertices(frames),
        body_faces=scene.body_faces,
    )
