"""Windows of several measurements, and what they answer to a model."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property

import numpy as np

from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.garment.topology import boundary_loops
from caphy.measure.noise import deviations, measurement_noise, noise_distance
from caphy.measure.scene import Scene
from caphy.measure.track import Progress
from caphy.measure.windows import LENGTH
from caphy.refit.clouds import all_registered
from caphy.refit.columns import Column
from caphy.refit.crew import Crew, Place
from caphy.refit.evidence import KINDS, estimated_variance
from caphy.refit.responses import Response, Watched, watched
from caphy.refit.tangents import Pushes

_EVENLY = (np.arange(100) + 0.5) / 100  # quantiles that stand for the noise of a film's points
FEWEST = 4
"""Windows without which nothing can be told."""


class Study:
    """The windows of some measurements."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        length: int = LENGTH,
        progress: Progress | None = None,
        crew: Crew | None = None,
        mesh: float | None = None,
        like: Study | None = None,
    ) -> None:
        """``crew`` rolls windows out, this process does unless given. ``mesh`` is how much of the mesh's error is in
        all windows, where that is known; it is free in each unless given. What is known of the windows of a study
        ``like`` it, of the same motions, holds here.

        Raises :class:`CaphyError` where there are too few windows, or some scenes were registered from clouds alone.
        """
        if len({scene.slides for scene in scenes}) > 1:
            raise CaphyError(KINDS)
        self.scenes, self.length, self.progress, self.crew = tuple(scenes), length, progress, crew
        self.mesh = mesh
        self.why_not = ""
        """Why its clouds could not be registered by another model, where that was tried."""
        self.watched = watched(scenes, length, None if like is None else like.watched)
        self._expected: list[np.ndarray] | None = None
        self.starts = [each.starts() for each in self.watched]
        if sum(map(len, self.starts)) < FEWEST:
            names = ", ".join(scene.measurement.source or scene.measurement.name for scene in scenes)
            raise CaphyError(
                f"{names}: needs at least {FEWEST} windows of {length} frames, each with half of the vertices seen "
                f"around its start, got {sum(map(len, self.starts))}; measure longer motions"
            )
        self._known_as = None if crew is None else crew.learn(self.scenes, length, like and like._known_as)

    @property
    def of_clouds(self) -> bool:
        """Whether its vertices were registered from clouds."""
        return any(scene.slides for scene in self.scenes)

    @property
    def on_body(self) -> bool:
        """Whether cloth meets a body in any of the scenes."""
        return any(each.scene.motion is not None for each in self.watched)

    @cached_property
    def openings(self) -> int:
        """How many of them the cloth has; none that a pinched boundary leaves undecided."""
        try:
            return len(boundary_loops(self.scenes[0].garment.faces))
        except ValueError:
            return 0

    @property
    def noise(self) -> float:
        """Standard deviation of a mode's coefficient by the noise of the measurements [m], the largest of them."""
        found = []
        for each in self.watched:
            noise = measurement_noise(each.scene.measurement)
            found.append(0.0 if noise is None else noise.sigma / np.sqrt(len(each.scene.garment.vertices)))
        return max(found)

    @property
    def floor_mm(self) -> float | None:
        """Median distance from the truth by noise alone in all windows together [mm]; None where no noise is known.

        Of clouds it is an upper bound, that of single points: how many of them a registered vertex averages depends on
        cloth and model.
        """
        sigma = np.zeros(0)
        for each, starts in zip(self.watched, self.starts, strict=True):
            if len(found := deviations(each.scene.measurement)):
                sigma = np.append(sigma, np.tile(np.quantile(found, _EVENLY), len(starts)))
        return 1e3 * noise_distance(sigma, 1 if self.of_clouds else 3) if len(sigma) else None

    def respond(
        self,
        model: Model,
        columns: Sequence[Column],
        what: str = "rolling out",
        pushes: Callable[[Watched], Pushes] | None = None,
        anew: Collection[str] = (),
        free: bool = False,
    ) -> list[Response]:
        """All windows against a model.

        Args:
            pushes: makes further forces, of no effect, to respond to.
            anew: errors to tell of this model even where an earlier one's are known: "start", "step", and "solver",
                those of time step and mesh. That of the mesh only where it is known how much the mesh does: a coarse
                one gives in less to a strong effect too, so that more of an error told anew and more of the effect
                would look alike.
            free: leave the mesh's error free in each window, to learn how much of it is there; all of ``anew`` is told.
        """
        places = [(number, frame) for number, starts in enumerate(self.starts) for frame in starts]
        found: dict[int, Response] = {}
        told = frozenset(anew) - {"solver"}
        if "solver" in anew:
            told |= {"step", "mesh"} if free or self.mesh is not None else {"step"}
        for place, response in self._responses(places, model, columns, pushes, told):
            wrong = 0.0 if self._expected is None else self._expected[place]
            known = response if free or self.mesh is None else response.with_mesh(self.mesh)
            found[place] = replace(known, residual=known.residual - wrong)
            if self.progress is not None:
                self.progress(what, len(found), len(places))
        return [found[place] for place in range(len(places))]

    def tell(self, model: Model, what: str) -> None:
        """Tell the errors of time step and mesh of a model in place of an earlier one's."""
        self.respond(model, (), what, anew={"solver"})

    def _responses(
        self,
        places: Sequence[Place],
        model: Model,
        columns: Sequence[Column],
        pushes: Callable[[Watched], Pushes] | None,
        errors: frozenset[str],
    ) -> Iterator[tuple[int, Response]]:
        if self.crew is not None and self._known_as is not None:
            yield from self.crew.respond(self._known_as, places, model, columns, pushes, errors)
            return
        first = 0
        for each, starts in zip(self.watched, self.starts, strict=True):
            forces = None if pushes is None else pushes(each)
            yield from enumerate(each.respond(model, columns, starts, forces, errors), first)
            first += len(starts)

    def correct(
        self, responses: Sequence[Response], columns: Sequence[Column], known: Mapping[str, float]
    ) -> list[Response]:
        """Take from residuals, in these responses and all to come, what base measurements taught to expect, in place of
        what was expected before.

        Args:
            columns: the first of the responses'.
            known: how much of each column, by name, stands for what mesh and solver get wrong.
        """
        change = np.array([known.get(column.name, 0.0) for column in columns])
        before = self._expected or [np.zeros_like(response.residual) for response in responses]
        self._expected = [response.columns[..., : len(change)] @ change for response in responses]
        return [
            replace(response, residual=response.residual + old - new)
            for response, old, new in zip(responses, before, self._expected, strict=True)
        ]

    def afresh(self) -> Study:
        """The same windows, of which nothing is known yet."""
        other = Study(self.scenes, self.length, self.progress, self.crew, self.mesh)
        other.starts = list(self.starts)
        return other

    def likewise(self) -> Study:
        """The same windows; what is known of them holds, and what this one is told from now on stays its own."""
        other = Study(self.scenes, self.length, self.progress, self.crew, self.mesh, self)
        other.starts, other._expected = list(self.starts), self._expected
        return other

    def some(self, windows: Collection[int]) -> Study:
        """Some of the windows, by their numbers among all; what is known of them holds."""
        other, numbers = copy(self), iter(range(sum(map(len, self.starts))))
        other.starts = [[start for start in starts if next(numbers) in windows] for starts in self.starts]
        if self._expected is not None:
            other._expected = [self._expected[number] for number in sorted(windows)]
        return other

    def registered_by(self, model: Model) -> Study:
        """The same windows, clouds registered by another model; what is known of them holds. This study itself where
        that model does not follow its clouds, which :attr:`why_not` says, or there are none."""
        self.why_not = ""
        if not self.of_clouds:
            return self
        try:
            clouds = [scene.unregistered for scene in self.scenes]
            scenes = all_registered(clouds, model, self.progress, self.crew)
            other = Study(scenes, self.length, self.progress, self.crew, self.mesh, self)
        except CaphyError as error:
            self.why_not = str(error)
            return self
        seen = [set(starts) for starts in other.starts]
        kept = [start in seen[number] for number, starts in enumerate(self.starts) for start in starts]
        if sum(kept) < FEWEST:
            self.why_not = f"only {sum(kept)} of {len(kept)} windows would be left"
            return self
        other.starts = [[s for s in starts if s in there] for starts, there in zip(self.starts, seen, strict=True)]
        if self._expected is not None:
            other._expected = [e for e, there in zip(self._expected, kept, strict=True) if there]
        return other

    def variance(self, responses: Sequence[Response]) -> np.ndarray:
        """The variance (L, M) [m^2] that nothing explains."""
        return estimated_variance(responses, self.noise)
