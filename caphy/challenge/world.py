"""Measurements with something hidden in them: what the user is given, and the answer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from caphy.challenge.dressed import skirt, tshirt
from caphy.challenge.hidden import Hidden, Verdict
from caphy.challenge.outside import FORCES
from caphy.challenge.recording import record, seen_by_user
from caphy.challenge.square import square
from caphy.challenge.stage import FPS, Stage
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement
from caphy.processes import executor

SCENES = {"square": square, "skirt": skirt, "tshirt": tshirt}
"""Scenes by name: what makes their stage from (seed, frames, same_mesh)."""


@dataclass(frozen=True, eq=False)
class World:
    """A challenge.

    Attributes:
        model: what the user believes: the truth without what is hidden.
        train: measurements to find it in.
        held_out: measurements of other motions, to prove it on.
        base: measurements of the same cloth before anything was hidden in it.
        answer: what was hidden, and how the data were made; plain JSON values.
    """

    model: Model
    train: tuple[Measurement, ...]
    held_out: tuple[Measurement, ...]
    base: tuple[Measurement, ...]
    answer: Mapping[str, Any]


def make(
    scene: str,
    hidden: Hidden,
    seed: int,
    *,
    noise_mm: float = 1.0,
    points: int | None = None,
    frames: int = 48,
    wrong: float = 0.0,
    cache: Path | None = None,
    processes: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> World:
    """Simulate a scene with something hidden in it, and measure it.

    Args:
        scene: one of :data:`SCENES`.
        hidden: what the user's model lacks; its strength and direction are drawn from the seed.
        seed: of the motions, the strength and the noise. What is hidden does not change the motions.
        noise_mm: standard deviation of each coordinate [mm].
        points: points in each frame's cloud; registered vertices unless given.
        frames: of each measurement.
        wrong: by how much, up and down in turn, the user's stiffnesses are off, as a share.
        cache: folder in which simulations are kept; noise is added afterwards.
        processes: simulate motions side by side where there are more than one.
        progress: told how many motions of how many are done.

    Raises:
        CaphyError: no such scene, what is hidden does nothing there, the cloth flew apart, or a process died.
    """
    if scene not in SCENES:
        raise CaphyError(f"there is no scene {scene!r}; known: {', '.join(SCENES)}")
    if not hidden.acts_in(scene):
        raise CaphyError(
            f"{hidden.name} does nothing in the scene {scene}; it acts in {', '.join(hidden.scenes or ())}"
        )
    hidden = hidden.drawn(np.random.default_rng([seed, 1]), scene)
    stage = SCENES[scene](seed, frames, hidden.same_mesh)
    found: dict[str, list[Measurement]] = {"train": [], "held_out": [], "base": []}
    films = _films(stage, hidden, seed, frames, cache, processes)
    for done, (play, film) in enumerate(zip(stage.plays, films, strict=True), 1):
        random = np.random.default_rng([seed, 2, ord(play.part[0]), play.number])
        found[play.part].append(seen_by_user(stage, play, film, noise_mm, points, random))
        if progress is not None:
            progress(done, len(stage.plays))
    model = _astray(stage.model, wrong)
    answer = _answer(stage, hidden, seed, noise_mm, points, frames, wrong)
    return World(model, tuple(found["train"]), tuple(found["held_out"]), tuple(found["base"]), answer)


def _films(
    stage: Stage, hidden: Hidden, seed: int, frames: int, cache: Path | None, processes: int
) -> Iterator[np.ndarray]:
    """Positions (T, V, 3) [m] of the truth's mesh in each play, one after another."""
    numbers = range(len(stage.plays))
    if processes <= 1:
        yield from (_film(stage, hidden, seed, frames, cache, number) for number in numbers)
        return
    filmed = partial(_filmed, stage.name, hidden, seed, frames, cache)
    with executor(min(processes, len(numbers))) as cameras:
        try:
            yield from cameras.map(filmed, numbers)
        except BrokenProcessPool as error:
            raise CaphyError("a process that simulated a motion died; is there memory enough for each core?") from error


def _filmed(name: str, hidden: Hidden, seed: int, frames: int, cache: Path | None, number: int) -> np.ndarray:
    """In a process of its own, which sets the stage for itself."""
    return _film(SCENES[name](seed, frames, hidden.same_mesh), hidden, seed, frames, cache, number)


def _film(stage: Stage, hidden: Hidden, seed: int, frames: int, cache: Path | None, number: int) -> np.ndarray:
    play = stage.plays[number]
    return record(stage, play, Hidden("nothing") if play.part == "base" else hidden, seed, frames, cache)


def _astray(model: Model, share: float) -> Model:
    """A model whose stiffnesses are too high and too low by a share, in turn."""
    up, down = 1 + share, 1 / (1 + share)
    for name, factors in (
        ("strain_stvk", {"lame_mu": up, "lame_lambda": down}),
        ("bending", {"stiffness_weft": down, "stiffness_warp": down}),
    ):
        values = model.effects[name]
        model = model.with_effect(name, **{key: values[key] * factor for key, factor in factors.items()})
    return model


def _answer(
    stage: Stage, hidden: Hidden, seed: int, noise_mm: float, points: int | None, frames: int, wrong: float
) -> dict[str, Any]:
    verdict: Verdict = "none of these" if hidden.outside else "named" if hidden.effects else "nothing"
    if wrong and not (hidden.outside or hidden.effects):
        verdict = "parameters"
    effects = {n: {k: np.asarray(v).tolist() for k, v in values.items()} for n, values in hidden.effects.items()}
    doc = FORCES[hidden.outside].__doc__ if hidden.outside else None
    return {
        "hidden": hidden.name,
        "verdict": verdict,
        "effects": effects,
        "outside": doc,
        "alike": {name: list(others) for name, others in hidden.alike.items()},
        "scene": stage.name,
        "seed": seed,
        "noise_mm": noise_mm,
        "points": points,
        "frames": frames,
        "frames_per_second": FPS,
        "parameters_wrong_by": wrong,
        "vertices_of_the_truth": len(stage.truth.vertices),
        "vertices_of_the_user": len(stage.user.vertices),
        "integrator": "leapfrog",
    }
