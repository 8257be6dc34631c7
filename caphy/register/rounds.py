"""The fit of all scans at once: poses with a shared shape, then poses with a shared displacement of the skin."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.body.surface import Surface
from caphy.register.articulation import Figure, PlacedFigure, Placement
from caphy.register.cloud import Cloud
from caphy.register.displacement import displacement_step
from caphy.register.prior import PosePrior
from caphy.register.semantic import Equations, Matches, equations, match

SHAPE_REACHES = np.geomspace(0.06, 0.01, 10)
"""Residual at which a point counts a quarter [m], in each round of pose and shape."""
SKIN_ROUNDS = 4
"""Rounds of displacement, each followed by pose steps."""
POSE_STEPS = 2
POSE_POINTS, SKIN_POINTS = 3000, 6000
"""Scan points that poses and the displacement are fitted to, for each scan."""
INDEPENDENT = 2.0
"""Scans' worth of evidence on the shape: the same skin and cloth err alike in each, unlike a pose's errors."""
ROUNDS = len(SHAPE_REACHES) + SKIN_ROUNDS


@dataclass(frozen=True, eq=False)
class Wearer:
    """One scan in the joint fit."""

    pose_cloud: Cloud
    """The points its pose is fitted to."""
    skin_cloud: Cloud
    """The points the displacement is fitted to."""
    prior: PosePrior

    @classmethod
    def of(cls, cloud: Cloud, prior: PosePrior) -> Wearer:
        """A scan thinned to what the rounds look at."""
        return cls(cloud.thinned(POSE_POINTS), cloud.thinned(SKIN_POINTS), prior)


@dataclass(frozen=True, eq=False)
class State:
    """What the rounds pass on, whole after each."""

    figure: Figure
    placements: tuple[Placement, ...]
    done: int = 0
    """Rounds finished."""


def run_round(state: State, wearers: Sequence[Wearer], surface: Surface, tick: Callable[[], None]) -> State:
    """The state after one more round; ``tick`` is called after each scan."""
    if state.done < len(SHAPE_REACHES):
        state = _shape_round(state, wearers, surface, float(SHAPE_REACHES[state.done]), tick)
    else:
        state = _skin_round(state, wearers, surface, tick)
    return replace(state, done=state.done + 1)


def _shape_round(
    state: State, wearers: Sequence[Wearer], surface: Surface, reach: float, tick: Callable[[], None]
) -> State:
    """One Gauss-Newton step of the shape and all poses together; the shape's coefficients are standard normal."""
    figure = state.figure
    counted = min(1.0, INDEPENDENT / len(wearers))
    matrix, right = np.eye(len(figure.betas)), -figure.betas
    steps: list[tuple[Equations, np.ndarray]] = []
    for wearer, placement in zip(wearers, state.placements, strict=True):
        placed, matches = _matched(figure, placement, surface, wearer.pose_cloud, reach, len(wearers))
        found = equations(placed, matches, *wearer.prior.residuals(placement, placed.world), True)
        part, value = found.without_pose()
        matrix, right = matrix + counted * part, right + counted * value
        steps.append((found, placed.world))
        tick()
    shape = np.linalg.solve(matrix, right)
    placements = [
        placement.moved(found.pose_step_with(shape), world)
        for placement, (found, world) in zip(state.placements, steps, strict=True)
    ]
    return replace(
        state, figure=Figure(figure.body, figure.betas + shape, figure.displacement), placements=tuple(placements)
    )


def _skin_round(state: State, wearers: Sequence[Wearer], surface: Surface, tick: Callable[[], None]) -> State:
    """The displacement for the poses as they are, then the poses for the new displacement."""
    figure, reach = state.figure, float(SHAPE_REACHES[-1])

    def found() -> Iterator[tuple[PlacedFigure, Matches]]:
        for wearer, placement in zip(wearers, state.placements, strict=True):
            yield _matched(figure, placement, surface, wearer.skin_cloud, reach, len(wearers))

    displacement = displacement_step(figure.body, figure.displacement, found())
    moved = Figure(figure.body, figure.betas, displacement)
    placements = []
    for wearer, before in zip(wearers, state.placements, strict=True):
        placement = before
        for _ in range(POSE_STEPS):
            placement = pose_step(moved, placement, wearer, surface, reach, len(wearers))
        placements.append(placement)
        tick()
    return replace(state, figure=moved, placements=tuple(placements))


def pose_step(
    figure: Figure, placement: Placement, wearer: Wearer, surface: Surface, reach: float, scans: int
) -> Placement:
    """One Gauss-Newton step of a single scan's pose, one of ``scans``."""
    placed, matches = _matched(figure, placement, surface, wearer.pose_cloud, reach, scans)
    known = wearer.prior.residuals(placement, placed.world)
    return placement.moved(equations(placed, matches, *known, False).pose_step(), placed.world)


def _matched(
    figure: Figure, placement: Placement, surface: Surface, cloud: Cloud, reach: float, scans: int
) -> tuple[PlacedFigure, Matches]:
    placed = figure.placed(placement)
    return placed, match(placed, surface, cloud, reach, scans)
