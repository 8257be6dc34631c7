"""Windows on a mesh with each face cut in four: how far a roll-out is the mesh's own.

Coarse triangles cannot bend in all directions without being stretched: they lock, and cloth made of them looks as if it
had shrunk. As Richardson did with time steps (Phil. Trans. R. Soc. A 210, 1911), the difference to a finer mesh tells
what the mesh does, in each window anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from caphy.garment.subdivision import Subdivision
from caphy.measure.scene import Scene
from caphy.measure.windows import roll_out
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import State
from caphy.solve.rollout import Simulator


class FinerMesh:
    """A scene on the subdivision of its cloth.

    Attributes:
        scene: the same measurement, body and pins with the finer cloth; windows of it go through :meth:`rolled_out`.
    """

    def __init__(self, scene: Scene) -> None:
        self._count, self._subdivision = len(scene.garment.vertices), Subdivision.of(scene.garment)
        garment, motion = self._subdivision.garment, scene.motion
        if isinstance(motion, BodyMotion):
            motion = BodyMotion(motion.body, motion.poses, garment, motion.betas)
        fixed, pins = _pinned(scene, self._subdivision.pairs)
        self.scene = replace(scene, garment=garment, motion=motion, fixed=fixed, pins=pins)

    def rolled_out(self, simulator: Simulator, state: State, frame: int, length: int) -> np.ndarray:
        """Positions (L + 1, V, 3) [m] of the coarse cloth's vertices on this mesh, from a ``state`` of the coarse one.

        ``simulator`` is one of :attr:`scene`.
        """
        x, v = (torch.from_numpy(self._subdivision.carried(field.numpy())) for field in (state.x, state.v))
        run = roll_out(self.scene, simulator, State(state.time, x, v), frame, length=length)
        return run.positions[:, : self._count]


def _pinned(scene: Scene, pairs: np.ndarray) -> tuple[np.ndarray | None, Callable[[float], torch.Tensor] | None]:
    """The mask (V + E,) and the pins where the middle of an edge between two pins is held too."""
    fixed, held = scene.fixed, scene.pins
    if fixed is None or held is None:
        return None, None
    both = fixed[pairs].all(axis=1)
    ends = torch.from_numpy((np.cumsum(fixed) - 1)[pairs[both]])

    def pins(time: float) -> torch.Tensor:
        x = held(time)
        return torch.cat([x, x[ends].mean(dim=1)])

    return np.concatenate([fixed, both]), pins
