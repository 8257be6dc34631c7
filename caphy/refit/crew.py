"""Processes that register clouds and roll out windows side by side: they know nothing of each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import fields, replace
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from caphy.body.model import BodyModel
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.io.measurements import Measurement
from caphy.kept import Kept
from caphy.measure.prediction import Window, Windows
from caphy.measure.scene import Scene
from caphy.measure.track import registered, registered_as
from caphy.measure.windows import LENGTH
from caphy.processes import cores, end_at_ctrl_c, one_thread_each
from caphy.refit.columns import Column
from caphy.refit.responses import ARRAYS, Response, Watched, watched
from caphy.refit.tangents import Pushes

Place = tuple[int, int]
"""A window: the number of its scene, and its first frame."""


class Crew:
    """As many processes as the machine has cores for.

    A window is always rolled out by the same process: what a process has learned of it (what the time step does) then
    does not depend on which one was free.
    """

    def __init__(self, effect_files: Sequence[Path] = (), size: int | None = None, kept: Path | None = None) -> None:
        """``effect_files`` hold effects of the user's own, which every process must know. With a folder ``kept`` what
        the processes find is written there, and not worked out again by those of a later crew."""
        found = Kept(kept, effect_files)
        size = cores() if size is None else size
        context = get_context("spawn")
        self._each = [ProcessPoolExecutor(1, context, _begin, (tuple(effect_files), found)) for _ in range(size)]
        self._studies = 0
        with one_thread_each():
            for each in self._each:
                each.submit(int)  # begins the process

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for each in self._each:
            each.shutdown(wait=kind is None, cancel_futures=True)

    def learn(self, scenes: Sequence[Scene], length: int, like: int | None = None) -> int:
        """Hand every process the scenes of a study; the number by which they know it.

        What they know of the windows of a study ``like`` it, of the same motions, holds.
        """
        self._studies += 1
        given = [(*_bound(s), s.ends) for s in scenes]
        for each in self._each:
            each.submit(_learn, self._studies, given, length, like)
        return self._studies

    def register(self, scenes: Sequence[Scene], model: Model) -> Iterator[tuple[int, Scene]]:
        """Scenes of clouds as :func:`~caphy.measure.track.registered`, each with its place in ``scenes``, in the order
        in which they are done.

        Raises:
            CaphyError: what registering raised, or a process died.
        """
        jobs = {
            self._each[i % len(self._each)].submit(_register, *_bound(scene), model): i
            for i, scene in enumerate(scenes)
        }
        for i, (measurement, ends) in self._done(jobs, "registered clouds"):
            yield i, replace(scenes[i], measurement=measurement, ends=ends, cloud=scenes[i].measurement)

    def respond(
        self,
        study: int,
        places: Sequence[Place],
        model: Model,
        columns: Sequence[Column],
        pushes: Callable[[Watched], Pushes] | None,
        anew: frozenset[str],
    ) -> Iterator[tuple[int, Response]]:
        """Windows of a study against a model, each with its place in ``places``, in the order in which they are done.

        Raises:
            CaphyError: what a window raised, or a process died.
        """
        jobs: dict[Future, list[int]] = {}
        for number in sorted({scene for scene, _ in places}):
            for who, each in enumerate(self._each):
                share = [i for i, place in enumerate(places) if place[0] == number and self._owner(place) == who]
                if share:
                    frames = [places[i][1] for i in share]
                    jobs[each.submit(_respond, study, number, frames, model, tuple(columns), pushes, anew)] = share
        for share, answers in self._done(jobs, "rolled out windows"):
            yield from zip(share, answers, strict=True)

    def _owner(self, place: Place) -> int:
        """The process that knows a window, the same in all studies of it, whichever of its windows they have."""
        number, frame = place
        return (number + frame // LENGTH) % len(self._each)

    def predict(self, scene: Scene, model: Model, length: int, starts: Sequence[int]) -> Iterator[Window]:
        """Windows of a scene that start at some frames, as :class:`caphy.measure.prediction.Windows` tells them, in the
        order in which they are done.

        Raises:
            CaphyError: what a window raised, or a process died.
        """
        self._studies += 1
        given = *_bound(scene), scene.ends, model, length
        for each in self._each:
            each.submit(_watch, self._studies, given)
        size = len(self._each)
        jobs = {self._each[i % size].submit(_predict, self._studies, frame): frame for i, frame in enumerate(starts)}
        for _, window in self._done(jobs, "rolled out windows"):
            yield window

    def _done(self, jobs: Mapping[Future, Any], what: str) -> Iterator[tuple[Any, Any]]:
        """What jobs stand for, and what they gave, as they are done."""
        try:
            for future in as_completed(jobs):
                yield jobs[future], future.result()
        except BrokenProcessPool as error:
            raise CaphyError(f"a process that {what} died; is there memory enough for each core?") from error
        except (GeneratorExit, Exception):  # not Ctrl-C, which the processes are ended by before they can be told
            for future in jobs:
                future.cancel()
            raise


_KNOWN: dict[int, list[Watched]] = {}
_GIVEN: dict[int, list[str]] = {}
"""What the scenes of studies are made of, as keys."""
_PREDICTED: dict[int, tuple[tuple, list[Windows]]] = {}
"""What windows are predicted from, and the windows once one was asked for."""
_kept = Kept()


def _begin(effect_files: Sequence[Path], kept: Kept) -> None:
    import torch

    from caphy.effects.registry import register_file

    global _kept  # noqa: PLW0603  (a process serves one crew)
    end_at_ctrl_c()
    torch.set_num_threads(1)
    for file in effect_files:
        register_file(file)
    _kept = kept


def _bound(scene: Scene) -> tuple[Measurement, Garment, BodyModel | None]:
    """What a scene is made of again in another process."""
    return scene.measurement, scene.garment, getattr(scene.motion, "body", None)


def _register(
    measurement: Measurement, garment: Garment, body: BodyModel | None, model: Model
) -> tuple[Measurement, np.ndarray | None]:
    scene = Scene.of(measurement, garment, body)
    key = _kept.key("register", measurement, garment, body, model)
    if (found := _kept.recall(key)) is not None:
        scene = registered_as(scene, found["vertices"], found["ends"], str(found["note"]))
    else:
        scene = registered(scene, model)
        of_cloud = {"vertices": scene.measurement.vertices, "ends": scene.ends, "note": scene.measurement.notes[-1]}
        _kept.keep(key, {name: np.asarray(value) for name, value in of_cloud.items()})
    return scene.measurement, scene.ends


def _learn(
    study: int,
    given: Sequence[tuple[Measurement, Garment, BodyModel | None, np.ndarray | None]],
    length: int,
    like: int | None,
) -> None:
    scenes = [replace(Scene.of(measured, garment, body), ends=ends) for measured, garment, body, ends in given]
    _KNOWN[study] = watched(scenes, length, None if like is None else _KNOWN[like])
    _GIVEN[study] = [_kept.key(length, *each) for each in given]


def _respond(
    study: int,
    number: int,
    frames: Sequence[int],
    model: Model,
    columns: Sequence[Column],
    pushes: Callable[[Watched], Pushes] | None,
    anew: frozenset[str],
) -> list[Response]:
    each = _KNOWN[study][number]
    of = _GIVEN[study][number], number, frames, each.errors_known(frames), model, columns, pushes, anew
    key = _kept.key("respond", *of)
    if (found := _kept.recall(key)) is not None:
        each.know_errors(frames, found["of_solver"], found["of_start"])
        return [Response(number, frame, *(found[name][i] for name in ARRAYS)) for i, frame in enumerate(frames)]
    answers = list(each.respond(model, columns, frames, None if pushes is None else pushes(each), anew))
    told = {name: np.stack([getattr(answer, name) for answer in answers]) for name in ARRAYS}
    of_solver, of_start = each.errors_known(frames)
    told |= {"of_solver": np.stack([*of_solver.values()]), "of_start": np.stack([*of_start.values()])}
    _kept.keep(key, told)
    return answers


def _watch(study: int, given: tuple[Measurement, Garment, BodyModel | None, np.ndarray | None, Model, int]) -> None:
    _PREDICTED[study] = given, []


def _predict(study: int, frame: int) -> Window:
    given, windows = _PREDICTED[study]
    key = _kept.key("predict", *given, frame)
    if (found := _kept.recall(key)) is not None:
        return Window(**found)
    if not windows:
        *bound, ends, model, length = given
        windows.append(Windows(replace(Scene.of(*bound), ends=ends), model, length))
    window = windows[0].told(frame)
    _kept.keep(key, {each.name: getattr(window, each.name) for each in fields(window)})
    return window
