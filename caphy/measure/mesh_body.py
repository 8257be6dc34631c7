"""A body that was measured as a moving mesh, seen by a garment like a posed one."""

from __future__ import annotations

import numpy as np
import torch

from caphy.body.surface import NearestPoints, Surface
from caphy.effects.base import BodyState
from caphy.solve.body_motion import set_out
from caphy.solve.following import Following
from caphy.solve.paths import path

_REACH = 0.05  # cloth nearer than this is carried along by the surface [m]


class MeshBody:
    """A closed mesh through given positions, cubic splines in between; at rest before the first and after the last.

    The same queries as :class:`caphy.solve.body_motion.BodyMotion`, but for anchors: nothing is attached to it.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, fps: float) -> None:
        """``vertices`` (T, B, 3) [m], ``faces`` (G, 3) wound outwards, ``fps`` [Hz]."""
        self.fps, self.faces, self._path = fps, faces, path(vertices, fps)
        self._surface = Following(Surface.of(faces, vertices[0]))

    def vertices(self, time: float) -> np.ndarray:
        """Positions (B, 3) [m] at a time [s]."""
        return self._path(time)

    def nearest(self, time: float, x: np.ndarray) -> NearestPoints:
        """Nearest points of the surface at a time [s] for positions x (V, 3) [m]."""
        return self._surface.nearest(time, x, self.vertices(time))

    def state(self, time: float, x: np.ndarray, dt: float, lead: float = 0.0) -> BodyState:
        """What positions x (V, 3) [m] see of the body at a time [s]; velocities as in a step of ``dt`` seconds."""
        found = self.nearest(time, x)
        set_out_at = sum(
            share * self._followed(found, then) for share, then in zip(*set_out(time, dt, lead), strict=True)
        )
        velocity = (found.point - set_out_at) / dt
        return BodyState(*(torch.from_numpy(field) for field in (found.point, found.normal, velocity, x.copy())))

    def carried(self, x: np.ndarray, free: np.ndarray, start: float, stop: float) -> np.ndarray:
        """A guess (V, 3) [m]: cloth at the surface moves along with it, cloth away from it flies freely."""
        found = self.nearest(start, x)
        near = np.clip(1 - np.abs(found.distance) / _REACH, 0, 1)[:, None]
        return near * (x + self._followed(found, stop) - found.point) + (1 - near) * free

    def _followed(self, found: NearestPoints, time: float) -> np.ndarray:
        """Where the material points found on the surface are at another time, (V, 3)."""
        return np.einsum("vk,vkc->vc", found.barycentric, self.vertices(time)[self.faces[found.face]])
