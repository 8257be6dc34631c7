"""The body as tiny time steps need it: nearest points found now and then, moved along with the body in between."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from caphy.body.surface import Surface
from caphy.effects.base import BodyState

FINER = 8
"""Poses of a body per frame of a recording; in between its vertices move in straight lines."""
INTERVAL = 1 / 960
"""Time [s] over which cloth keeps the tangent planes of its nearest points."""


@dataclass(frozen=True, eq=False)
class MovingBody:
    """A closed surface in motion; before its first and after its last pose it stands still.

    Attributes:
        vertices: (N, B, 3) [m].
        faces: (G, 3), wound outwards.
        rate: poses per second [Hz].
        anchors: where the skinned template has the cloth's vertices, (N, V, 3) [m]; none where nothing is attached.
    """

    vertices: np.ndarray
    faces: np.ndarray
    rate: float
    anchors: np.ndarray | None = None

    @cached_property
    def surface(self) -> Surface:
        """For queries of nearest points."""
        return Surface.of(self.faces, self.vertices[0])

    def at(self, time: float) -> np.ndarray:
        """Vertices (B, 3) [m] at a time [s]."""
        return self._between(self.vertices, time)

    def anchors_at(self, time: float, x: np.ndarray) -> np.ndarray:
        """Anchors (V, 3) [m] at a time [s]; positions x (V, 3) themselves where nothing is attached."""
        return x if self.anchors is None else self._between(self.anchors, time)

    def _between(self, track: np.ndarray, time: float) -> np.ndarray:
        place = min(max(time * self.rate, 0.0), len(track) - 1.0)
        first = min(int(place), len(track) - 2)
        return track[first] + (place - first) * (track[first + 1] - track[first])


class ContactPlanes:
    """Tangent planes and anchors of a moving body: found for the end of each interval, carried there linearly."""

    def __init__(self, body: MovingBody | None, time: float) -> None:
        """``time`` [s] is when the simulation begins."""
        self.body, self._until = body, time
        self._end: tuple[np.ndarray, ...] | None = None
        self._faces: np.ndarray | None = None

    def at(self, time: float, x: np.ndarray, v: np.ndarray) -> BodyState | None:
        """What the body is to positions x (V, 3) [m] and velocities v (V, 3) [m/s] at a time [s] that only rises."""
        if self.body is None:
            return None
        if self._end is None or time >= self._until - 1e-9:
            self._end = self._look(self.body, time, x, v)
        left = self._until - time
        point, normal, velocity, anchor = self._end
        earlier = anchor + (left / INTERVAL) * (self._anchor - anchor)
        return BodyState(*map(torch.from_numpy, (point - left * velocity, normal, velocity, earlier)))

    def _look(self, body: MovingBody, time: float, x: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        self._until = time + INTERVAL
        now, before = body.at(self._until), body.at(time)
        found = body.surface.nearest(x + INTERVAL * v, now, self._faces)
        self._faces = found.face
        corners = body.faces[found.face]
        velocity = np.einsum("vk,vkc->vc", found.barycentric, (now - before)[corners]) / INTERVAL
        self._anchor = body.anchors_at(time, x)
        return found.point, found.normal, velocity, body.anchors_at(self._until, x)
