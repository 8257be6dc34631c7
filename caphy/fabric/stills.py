"""Scans of a garment at rest: the points that show it, and the body it is worn on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree
from torch import Tensor

from caphy.body.model import BodyModel
from caphy.effects.base import BodyState
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.solve.body_motion import BodyMotion

NEIGHBOURS = 12
"""Points that tell the normal of one."""


@dataclass(frozen=True, eq=False)
class Still:
    """One scan of one garment.

    Attributes:
        name: of the scan.
        points: that show the garment (N, 3) [m], world axes, y up.
        pose, transl: of the body (55, 3) [rad], (3,) [m].
    """

    name: str
    points: np.ndarray
    pose: np.ndarray
    transl: np.ndarray


@dataclass(frozen=True, eq=False)
class Worn:
    """A garment on the body of one still."""

    still: Still
    body: BodyModel
    garment: Garment

    @cached_property
    def poses(self) -> PoseSequence:
        """The pose as a sequence of one frame."""
        pelvis = self.body.joints[0]
        return PoseSequence(
            self.still.pose[None], self.still.transl[None], fps=1.0, source=self.still.name, pelvis=pelvis
        )

    @cached_property
    def motion(self) -> BodyMotion:
        """The body that stands still in it."""
        return BodyMotion(self.body, self.poses, self.garment)

    @cached_property
    def facing(self) -> np.ndarray:
        """Normal at each point (N, 3): of the plane through its neighbours, away from the body."""
        points = self.still.points
        near = points[KDTree(points).query(points, NEIGHBOURS)[1]]
        centred = near - near.mean(axis=1, keepdims=True)
        normal = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][:, :, 0]
        out = points - self.motion.nearest(0.0, points).point
        return normal * np.sign(np.einsum("nc,nc->n", normal, out))[:, None]

    def seen(self, x: Tensor) -> BodyState:
        """What positions x (V, 3) [m] see of the body."""
        return self.motion.state(0.0, x.numpy(), 1.0)

    def skinned(self) -> np.ndarray:
        """The garment's template carried along by the skeleton (V, 3) [m]."""
        return self.motion.anchors(np.zeros(1))[0]
