"""Where the parts of a T-posed body are: dense surface samples by part, and the heights garments refer to."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from caphy.body.model import BodyModel
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.garment import topology

PARTS = {
    "head": ("head", "jaw", "left_eye", "right_eye"),
    "neck": ("neck",),
    "arm": ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
    "hand": ("left_wrist", "right_wrist", *JOINT_NAMES[25:]),
    "leg": ("left_hip", "right_hip", "left_knee", "right_knee"),
    "foot": ("left_ankle", "right_ankle", "left_foot", "right_foot"),
    "trunk": ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar"),
}
LEG = ("hip", "knee", "ankle", "foot")
"""Joints of a leg."""


@dataclass(frozen=True)
class Landmarks:
    """One body shape in T-pose; lengths in metres, y up, facing +z."""

    body: BodyModel
    vertices: np.ndarray
    """Rest vertices (V, 3)."""
    joints: np.ndarray
    """Rest joints (55, 3)."""

    @classmethod
    def of(cls, body: BodyModel, betas: np.ndarray | None = None) -> Landmarks:
        """Landmarks of ``body`` in shape ``betas`` (S,)."""
        return cls(body, *body.rest(betas))

    def joint(self, name: str) -> np.ndarray:
        """Position (3,) of a joint."""
        return self.joints[JOINT_NAMES.index(name)]

    @cached_property
    def _samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) spread over the surface and the index of the part that each belongs to."""
        order = 4
        share = np.array([(i, j, order - i - j) for i in range(order + 1) for j in range(order + 1 - i)]) / order
        groups = [[JOINT_NAMES.index(n) for n in names] for names in PARTS.values()]
        weights = np.stack([self.body.weights[:, g].sum(axis=1) for g in groups], axis=1)
        points = np.einsum("sk,fkd->fsd", share, self.vertices[self.body.faces]).reshape(-1, 3)
        owner = np.einsum("sk,fkd->fsd", share, weights[self.body.faces]).reshape(-1, len(groups))
        return points, owner.argmax(axis=1)

    def samples(self, *parts: str) -> np.ndarray:
        """Dense points (N, 3) on the surface of the named :data:`PARTS`."""
        points, owner = self._samples
        return points[np.isin(owner, [list(PARTS).index(p) for p in parts])]

    @cached_property
    def height(self) -> float:
        """Stature."""
        return float(np.ptp(self.vertices[:, 1]))

    @cached_property
    def crotch(self) -> float:
        """Height y of the lowest point between the legs: of the line on the skin where both hips weigh alike.

        Where thighs come near each other is no measure of it: on heavy bodies that is centimetres below.

        Raises:
            CaphyError: the skinning weights tell no left leg from a right one.
        """
        left, right = (
            self.body.weights[:, [JOINT_NAMES.index(f"{side}_{name}") for name in LEG]].sum(axis=1)
            for side in ("left", "right")
        )
        edges = topology.edges(self.body.faces)
        a, b = (left - right)[edges].T
        across = (a > 0) != (b > 0)
        if not across.any():
            raise CaphyError(
                "a body must have skin between its legs, where left and right hip weigh alike, got none; "
                "do its skinning weights have the order of SMPL-X's joints?"
            )
        (start, end), a, b = edges[across].T, a[across], b[across]
        share, height = a / (a - b), self.vertices[:, 1]
        return float(((1 - share) * height[start] + share * height[end]).min())

    @cached_property
    def armpit(self) -> float:
        """Height y of the underside of the upper arm, 5 cm out from the shoulder joint."""
        arm = self.samples("arm")
        near = np.abs(np.abs(arm[:, 0]) - self.joint("left_shoulder")[0] - 0.05) < 0.015
        return float(arm[near, 1].min())

    @cached_property
    def neck_half_width(self) -> float:
        """Half the width of the neck just above its base."""
        neck = self.samples("neck", "trunk")
        level = np.abs(neck[:, 1] - self.joint("neck")[1] - 0.03) < 0.012
        return float(np.abs(neck[level, 0]).max())

    def mirrored(self, *parts: str) -> np.ndarray:
        """Samples of the parts with their mirror images (2N, 3), so that garments come out symmetric."""
        points = self.samples(*parts)
        return np.concatenate([points, points * [-1.0, 1.0, 1.0]])

    def left(self, *parts: str) -> np.ndarray:
        """Samples of the parts with the right half folded onto the left (x >= 0)."""
        points = self.samples(*parts)
        return np.concatenate([np.abs(points[:, :1]), points[:, 1:]], axis=1)
