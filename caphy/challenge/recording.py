"""Playing a motion with something hidden, and what cameras would have seen of it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from caphy.body.surface import nearest_on_surface
from caphy.challenge.hidden import Hidden
from caphy.challenge.leapfrog import FlewApart, Force, Leapfrog
from caphy.challenge.outside import FORCES
from caphy.challenge.stage import FPS, RUN_UP, Play, Stage
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.garment.template import Garment, read_npz, write_npz
from caphy.garment.topology import face_areas
from caphy.io.measurements import Measurement
from caphy.solve.integrators import State

REVISION = 6
"""Raised whenever the same arguments give another motion, so that no older film is taken from a cache."""

_HASTES = (1.0, 1.5, 2.25)  # at rest, where steps are chosen, cloth may be less stiff than where it moves to


def record(stage: Stage, play: Play, hidden: Hidden, seed: int, frames: int, cache: Path | None) -> np.ndarray:
    """Positions (T, V, 3) [m] of the truth's mesh in each frame of a play."""
    if cache is None:
        return _simulated(stage, play, hidden, frames)
    path = cache / f"{stage.name}-{play.part}-{play.number}-{_key(stage, hidden, seed, frames)}.npz"
    if not path.is_file():
        write_npz(path, {"positions": _simulated(stage, play, hidden, frames).astype(np.float32)})
    return read_npz(path)["positions"].astype(np.float64)


def truth_model(model: Model, hidden: Hidden) -> Model:
    """A model with the effects of the library that are hidden."""
    for name, values in hidden.effects.items():
        model = model.with_effect(name, **values)
    return model


def simulator(stage: Stage, play: Play, hidden: Hidden) -> Leapfrog:
    """What moves the truth's mesh in a play."""
    cloth = Cloth.of(stage.truth, stage.model.density)
    force: Force | None = None
    if hidden.outside is not None:
        outside = FORCES[hidden.outside]
        force = lambda x, v, time: outside(x, v, time, cloth)  # noqa: E731
    return Leapfrog(truth_model(stage.model, hidden), cloth, play.drive, force)


def played(stage: Stage, play: Play, hidden: Hidden, frames: int) -> list[State]:
    """States of the truth's mesh in each frame of a play."""
    leapfrog = simulator(stage, play, hidden)
    for haste in _HASTES[:-1]:
        try:
            return _run(leapfrog.hurried(haste), play, frames)
        except FlewApart:
            continue
    return _run(leapfrog.hurried(_HASTES[-1]), play, frames)


def _run(leapfrog: Leapfrog, play: Play, frames: int) -> list[State]:
    calm = leapfrog.run(play.start, round((-play.start.time - RUN_UP) * FPS), FPS, calming=8.0)[-1]
    return leapfrog.run(calm, round(RUN_UP * FPS) + frames - 1, FPS)[-frames:]


def _simulated(stage: Stage, play: Play, hidden: Hidden, frames: int) -> np.ndarray:
    return np.stack([state.x.numpy() for state in played(stage, play, hidden, frames)])


def _key(stage: Stage, hidden: Hidden, seed: int, frames: int) -> str:
    effects = {n: {k: np.asarray(v).tolist() for k, v in values.items()} for n, values in hidden.effects.items()}
    mesh = mesh_digest(stage.truth)
    said = [REVISION, stage.name, effects, hidden.outside, mesh, seed, frames, stage.model.to_json()]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:20]


def mesh_digest(garment: Garment) -> str:
    """What tells a mesh from another of the same garment: remeshing follows a processor's rounding, so that a film made
    on one machine need not fit the mesh that another one makes."""
    return hashlib.sha256(garment.vertices.tobytes() + garment.faces.tobytes()).hexdigest()[:20]


def seen_by_user(
    stage: Stage, play: Play, film: np.ndarray, noise_mm: float, points: int | None, random: np.random.Generator
) -> Measurement:
    """The measurement of a film (T, V, 3): the user's vertices wherever they lie on the truth's mesh, or clouds."""
    user = stage.user
    if points is None:
        positions = followed(user.vertices, stage.truth, film)
        noisy = {"vertices": positions + random.normal(0, 1e-3 * noise_mm, positions.shape)}
    else:
        clouds = np.concatenate([scattered(stage.truth, x, points, random) for x in film])
        offsets = np.arange(len(film) + 1) * points
        noisy = {"points": clouds + random.normal(0, 1e-3 * noise_mm, clouds.shape), "offsets": offsets}
    return Measurement(
        name=f"{play.part}_{play.number}",
        fps=FPS,
        faces=user.faces,
        rest_vertices=user.vertices,
        material=user.material,
        noise_mm=noise_mm,
        **noisy,
        **play.keys,
    )


def followed(points: np.ndarray, truth: Garment, film: np.ndarray) -> np.ndarray:
    """Where points (N, 3) [m] of the rest shape are in each frame, (T, N, 3) [m]."""
    found = nearest_on_surface(points, truth.vertices, truth.faces)
    return np.einsum("nk,tnkc->tnc", found.barycentric, film[:, truth.faces[found.face]])


def scattered(truth: Garment, x: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Points (count, 3) [m] spread evenly over the cloth at positions x (V, 3), other ones in every frame."""
    area = face_areas(x, truth.faces)
    corners = x[truth.faces[random.choice(len(area), count, p=area / area.sum())]]
    a, b = random.uniform(size=(2, count))
    root = np.sqrt(a)
    return np.einsum("kn,nkc->nc", np.stack([1 - root, root * (1 - b), root * b]), corners)
