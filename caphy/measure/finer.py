"""Windows on a mesh with four times as many faces: how far a roll-out is the mesh's own.

Coarse triangles cannot bend in all directions without being stretched: they lock, and cloth made of them looks as if it
had shrunk. As Richardson did with time steps (Phil. Trans. R. Soc. A 210, 1911), the difference to a finer mesh tells
what the mesh does, in each window anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from caphy.garment.lattice import Lattice
from caphy.garment.subdivision import Subdivision
from caphy.measure.scene import Scene
from caphy.measure.windows import roll_out
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import State
from caphy.solve.rollout import Simulator


class FinerMesh:
    """A scene with a finer mesh of its cloth: a lattice where the cloth is flat, else each face cut in four.

    Attributes:
        scene: the same measurement, body and pins with the finer cloth; windows of it go through :meth:`rolled_out`.
    """

    def __init__(self, scene: Scene) -> None:
        self._mesh = Lattice.of(scene.garment, scene.fixed) or Subdivision.of(scene.garment)
        garment, motion = self._mesh.garment, scene.motion
        if isinstance(motion, BodyMotion):
            motion = BodyMotion(motion.body, motion.poses, garment, motion.betas)
        fixed, pins = _pinned(scene, self._mesh.ends)
        self.scene = replace(scene, garment=garment, motion=motion, fixed=fixed, pins=pins)

    def rolled_out(self, simulator: Simulator, state: State, frame: int, length: int) -> np.ndarray:
        """Positions (L + 1, V, 3) [m] of the coarse cloth's vertices on this mesh, from a ``state`` of the coarse one.

        ``simulator`` is one of :attr:`scene`. Coarse vertices that lie within faces of this mesh are followed from
        where the state has them, not from the fine face beside them.
        """
        x, v = (torch.from_numpy(self._mesh.carried(field.numpy())) for field in (state.x, state.v))
        run = roll_out(self.scene, simulator, State(state.time, x, v), frame, length=length)
        seen = np.stack([self._mesh.seen(x) for x in run.positions])
        return seen + (state.x.numpy() - seen[0])


def _pinned(scene: Scene, ends: np.ndarray) -> tuple[np.ndarray | None, Callable[[float], torch.Tensor] | None]:
    """The mask (N,) and the pins where the middle of an edge between two pins is held too."""
    fixed, held = scene.fixed, scene.pins
    if fixed is None or held is None:
        return None, None
    both = np.all(ends >= 0, axis=1) & np.all(fixed[ends], axis=1)
    between = torch.from_numpy((np.cumsum(fixed) - 1)[ends[both]])
    return both, lambda time: held(time)[between].mean(dim=1)
