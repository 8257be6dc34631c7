"""A posed body with the exact derivatives of its surface points by pose, place and shape.

A small turn ``w`` [rad, world axes] of joint k carries the part of a vertex that hangs on k and its descendants round
the joint: ``dv = w x (a_k - W_k p_k)``, with ``W_k`` the weights of that subtree, ``a_k`` the weighted sum of where its
joints carry the vertex, and ``p_k`` the joint. Fingers, jaw and eyes turn with wrist and head. Pose correctives, where
a body has them, move the vertices but are left out of the derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from caphy.body.kinematics import joint_transforms
from caphy.body.model import POSE_FEATURES, BodyModel
from caphy.body.skinning import blend_transforms, skin
from caphy.conventions import BODY_JOINT_COUNT, JOINT_COUNT, JOINT_PARENTS
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle

TURNS = 3 * BODY_JOINT_COUNT
"""Unknown turns of one pose; its three translations follow them."""
POSE_UNKNOWNS = TURNS + 3


def _carrier(joint: int) -> int:
    return joint if joint < BODY_JOINT_COUNT else _carrier(JOINT_PARENTS[joint])


CARRIERS = np.array([_carrier(joint) for joint in range(JOINT_COUNT)])
"""The body joint that each joint moves with, (55,)."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where one scan's body stands."""

    rotations: np.ndarray
    """Rotation of each joint against its parent, (55, 3, 3)."""
    transl: np.ndarray
    """Translation added after posing (3,) [m]."""

    @classmethod
    def of(cls, pose: np.ndarray, transl: np.ndarray) -> Placement:
        """The placement of a pose (55, 3) [rad] and a translation (3,) [m]."""
        return cls(matrix_from_axis_angle(np.asarray(pose, np.float64)), np.asarray(transl, np.float64))

    @property
    def pose(self) -> np.ndarray:
        """Axis-angle of each joint (55, 3) [rad]."""
        return axis_angle_from_matrix(self.rotations)

    def moved(self, step: np.ndarray, world: np.ndarray) -> Placement:
        """After a step (69,): turns about world axes [rad] of the 22 body joints, then the translation [m].

        ``world`` (55, 3, 3) are the joints' world rotations before the step.
        """
        turn = matrix_from_axis_angle(step[:TURNS].reshape(-1, 3))
        rotations = self.rotations.copy()
        rotations[0] = turn[0] @ rotations[0]
        above = world[list(JOINT_PARENTS[1:BODY_JOINT_COUNT])]
        rotations[1:BODY_JOINT_COUNT] = above.transpose(0, 2, 1) @ turn[1:] @ above @ rotations[1:BODY_JOINT_COUNT]
        return replace(self, rotations=rotations, transl=self.transl + step[TURNS:POSE_UNKNOWNS])


@dataclass(frozen=True, eq=False)
class Figure:
    """A body of one shape and displacement, ready to be posed again and again."""

    body: BodyModel
    betas: np.ndarray
    """Shape coefficients (S,), S as many as are free."""
    displacement: np.ndarray
    """Rest displacement (V, 3) [m] on top of the shape."""

    @classmethod
    def of(cls, body: BodyModel, betas: np.ndarray | None = None, displacement: np.ndarray | None = None) -> Figure:
        """A figure of ``body``; the mean shape without displacement unless given."""
        betas = np.zeros(shape_count(body)) if betas is None else np.asarray(betas, np.float64)
        return cls(body, betas, np.zeros_like(body.v_template) if displacement is None else displacement)

    @cached_property
    def rest(self) -> tuple[np.ndarray, np.ndarray]:
        """Rest vertices (V, 3) and joints (55, 3) [m]."""
        vertices, joints = self.body.rest(self.betas)
        return vertices + self.displacement, joints

    def placed(self, placement: Placement) -> PlacedFigure:
        """The figure where ``placement`` puts it."""
        return PlacedFigure(self, placement)


class PlacedFigure:
    """A figure in one pose: vertices, and what their derivatives are made of."""

    def __init__(self, figure: Figure, placement: Placement):
        self.figure, self.placement = figure, placement
        body, (rest, joints) = figure.body, figure.rest
        self.transforms = joint_transforms(placement.rotations, joints, body.parents)
        if body.posedirs is not None:
            feature = (placement.rotations[1:] - np.eye(3)).reshape(POSE_FEATURES)
            rest = rest + body.posedirs @ feature
        self.corrected = rest
        """Rest vertices with the pose's correctives (V, 3) [m]."""
        self.blended = blend_transforms(body.weights, self.transforms)
        """Per-vertex transforms (V, 3, 4)."""
        self.vertices = skin(self.blended, rest) + placement.transl
        """Posed vertices (V, 3) [m]."""
        self.world = self.transforms[..., :3]
        """World rotations of the joints (55, 3, 3)."""

    @cached_property
    def joints(self) -> np.ndarray:
        """Posed joints (55, 3) [m]."""
        turned = (self.world @ self.figure.rest[1][..., None])[..., 0]
        return turned + self.transforms[..., 3] + self.placement.transl

    @cached_property
    def levers(self) -> np.ndarray:
        """For each body joint ``a_k - W_k p_k`` of every vertex, (22, V, 3) [m]."""
        body = self.figure.body
        slots, slot_weights = influences(body)
        own = np.zeros((BODY_JOINT_COUNT, len(self.vertices), 4))
        rows = np.arange(len(self.vertices))
        for slot, weight in zip(slots.T, slot_weights.T, strict=True):
            there = np.einsum("vij,vj->vi", self.world[slot], self.corrected) + self.transforms[slot, :, 3]
            own[CARRIERS[slot], rows, :3] += weight[:, None] * (there + self.placement.transl)
            own[CARRIERS[slot], rows, 3] += weight
        for joint in range(BODY_JOINT_COUNT - 1, 0, -1):
            own[JOINT_PARENTS[joint]] += own[joint]
        return own[..., :3] - own[..., 3:] * self.joints[:BODY_JOINT_COUNT, None]

    @cached_property
    def shape_derivatives(self) -> np.ndarray:
        """Movement of every vertex per unit of each shape coefficient, (V, 3, S) [m]."""
        body, count = self.figure.body, len(self.figure.betas)
        joint_dirs = body.joint_shapedirs[..., :count]
        place = joint_dirs.copy()
        for joint in range(1, JOINT_COUNT):
            parent = JOINT_PARENTS[joint]
            place[joint] = place[parent] + self.world[parent] @ (joint_dirs[joint] - joint_dirs[parent])
        shift = place - self.world @ joint_dirs
        turned = self.blended[..., :3] @ body.shapedirs[..., :count]
        return turned + np.tensordot(body.weights, shift, axes=1)

    def points(self, face: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Points (N, 3) on faces (N,) at barycentric weights (N, 3)."""
        return np.einsum("nk,nkc->nc", share, self.vertices[self.figure.body.faces[face]])

    def rows(self, face: np.ndarray, share: np.ndarray, direction: np.ndarray, shape: bool) -> np.ndarray:
        """Derivatives (N, 69 or 69 + S) of ``direction . point`` by pose, translation and, if asked, shape.

        Args:
            face: face of each point (N,).
            share: its barycentric weights (N, 3).
            direction: a vector for each point (N, 3).
        """
        corners = self.figure.body.faces[face]
        lever = sum(share[:, k, None] * self.levers[:, corners[:, k]] for k in range(3))
        turns = np.cross(lever, direction).transpose(1, 0, 2).reshape(len(face), TURNS)
        parts = [turns, direction]
        if shape:
            moves = sum(share[:, k, None, None] * self.shape_derivatives[corners[:, k]] for k in range(3))
            parts.append(np.einsum("nc,ncs->ns", direction, moves))
        return np.concatenate(parts, axis=1)


def shape_count(body: BodyModel) -> int:
    """How many shape coefficients are fitted: all, but at most ten."""
    return min(10, body.shapedirs.shape[2])


@lru_cache(maxsize=4)
def influences(body: BodyModel) -> tuple[np.ndarray, np.ndarray]:
    """The joints (V, K) that move each vertex, and their weights (V, K); K is the most any vertex has."""
    count = int((body.weights > 0).sum(axis=1).max())
    slots = np.argsort(-body.weights, axis=1, kind="stable")[:, :count]
    return slots, np.take_along_axis(body.weights, slots, axis=1)
