"""The body as tiny time steps need it: nearest points found now and then, moved along with the body in between."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import BodyState
from caphy.measure.mesh_body import MeshBody
from caphy.solve.body_motion import BodyMotion

INTERVAL = 1 / 240
"""Time [s] over which cloth keeps the tangent planes of its nearest points."""


class ContactPlanes:
    """Tangent planes and anchors of a moving body: found for the end of each interval, carried there linearly."""

    def __init__(self, body: BodyMotion | MeshBody | None, time: float) -> None:
        """``time`` [s] is when the simulation begins."""
        self.body, self._until = body, time
        self._end: BodyState | None = None
        self._anchor: Tensor | None = None

    def at(self, time: float, x: np.ndarray, v: np.ndarray) -> BodyState | None:
        """What the body is to positions x (V, 3) [m] and velocities v (V, 3) [m/s] at a time [s] that only rises."""
        if self.body is None:
            return None
        if self._end is None or time >= self._until - 1e-9:
            self._look(self.body, time, x, v)
        assert self._end is not None and self._anchor is not None
        left = self._until - time
        point = self._end.point - left * self._end.velocity
        anchor = self._end.anchor + (left / INTERVAL) * (self._anchor - self._end.anchor)
        return BodyState(point, self._end.normal, self._end.velocity, anchor)

    def _look(self, body: BodyMotion | MeshBody, time: float, x: np.ndarray, v: np.ndarray) -> None:
        last = body.state(time, x, INTERVAL) if self._end is None else self._end
        self._anchor, self._until = last.anchor, time + INTERVAL
        self._end = body.state(self._until, x + INTERVAL * v, INTERVAL)
