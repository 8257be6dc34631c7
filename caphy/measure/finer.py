"""Windows on a finer mesh: how far a roll-out is the mesh's own.

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
from caphy.measure.windows import WindowRun, roll_out
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import State
from caphy.solve.rollout import Simulator


class FinerMesh:
    """A scene with a finer mesh of its cloth: a lattice where the cloth is flat, else each face cut in four.

    Attributes:
        scene: the same measurement, body and pins with the finer cloth; windows of it go through :meth:`difference`.
    """

    def __init__(self, scene: Scene) -> None:
        self._mesh = Lattice.of(scene.garment, scene.fixed) or Subdivision.of(scene.garment)
        garment, motion = self._mesh.garment, scene.motion
        if isinstance(motion, BodyMotion):
            motion = BodyMotion(motion.body, motion.poses, garment, motion.betas)
        fixed, pins = _pinned(scene, self._mesh.ends)
        self.scene = replace(scene, garment=garment, motion=motion, fixed=fixed, pins=pins)

    def difference(self, simulator: Simulator, state: State, coarse: WindowRun) -> np.ndarray:
        """What edges half as long would change (L + 1, V, 3) [m] in a window of the coarse cloth, from its ``state``.

        ``simulator`` is one of :attr:`scene`. Coarse vertices that lie within faces of this mesh are followed from
        where the state has them, not from the fine face beside them. Errors fall with the square of edges, so that
        what edges of another length change tells what half as long ones would.
        """
        x, v = (torch.from_numpy(self._mesh.carried(field.numpy())) for field in (state.x, state.v))
        length = len(coarse.positions) - 1
        run = roll_out(self.scene, simulator, State(state.time, x, v), coarse.start, length=length)
        seen = np.stack([self._mesh.seen(x) for x in run.positions])
        change = (seen - seen[0]) - (coarse.positions - coarse.positions[0])
        return (1 - 0.5**2) / (1 - self._mesh.shorter**2) * change


def _pinned(scene: Scene, ends: np.ndarray) -> tuple[np.ndarray | None, Callable[[float], torch.Tensor] | None]:
    """The mask (N,) and the pins where the middle of an edge between two pins is held too."""
    fixed, held = scene.fixed, scene.pins
    if fixed is None or held is None:
        return None, None
    both = np.all(ends >= 0, axis=1) & np.all(fixed[ends], axis=1)
    between = torch.from_numpy((np.cumsum(fixed) - 1)[ends[both]])
    return both, lambda time: held(time)[between].mean(dim=1)
