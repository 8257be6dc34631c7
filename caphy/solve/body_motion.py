"""A body in motion as a garment sees it: nearest surface points, surface velocities and skinned anchors at any time."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch

from caphy.body.kinematics import joint_transforms
from caphy.body.model import BodyModel
from caphy.body.skinning import blend_transforms, skin
from caphy.body.surface import NearestPoints, nearest_on_faces, nearest_on_surface
from caphy.effects.base import BodyState
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.rotations import axis_angle_from_quaternion, matrix_from_axis_angle, quaternion_from_axis_angle, slerp

_REMEMBERED = 16  # posed bodies kept; a step asks for a few times, again and again


class BodyMotion:
    """A body model moving through a pose sequence, and the garment worn on it.

    Time runs in seconds from the first frame; before the first and after the last frame the body stands still.
    Between frames joint rotations are interpolated by slerp and the root's translation linearly, so that limbs keep
    their lengths. Everything is numpy float64 in the world frame (y up) except :class:`BodyState`, which is torch.

    Attributes:
        body, poses, garment: as given; ``poses`` with y up.
        fps: frames per second [Hz].
    """

    def __init__(self, body: BodyModel, poses: PoseSequence, garment: Garment, betas: np.ndarray | None = None) -> None:
        """``betas`` (S,) is the body shape the garment was made on; the sequence's own betas are not used."""
        self.body, self.garment, self.betas = body, garment, betas
        self._joints = body.rest(betas)[1]
        self.poses = poses.to_y_up(self._joints[0])
        self.fps = self.poses.fps
        self._quaternions = quaternion_from_axis_angle(self.poses.poses)
        self._posed: OrderedDict[float, np.ndarray] = OrderedDict()

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.poses)

    @property
    def times(self) -> np.ndarray:
        """Times of the frames (T,) [s]."""
        return np.arange(len(self)) / self.fps

    def pose(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint rotations (N, 55, 3) [rad] and translations (N, 3) [m] at times (N,) [s]."""
        place = np.clip(np.atleast_1d(times) * self.fps, 0, len(self) - 1)
        first = np.minimum(place.astype(int), max(len(self) - 2, 0))
        second = np.minimum(first + 1, len(self) - 1)
        fraction = (place - first)[:, None]
        mixed = slerp(self._quaternions[first], self._quaternions[second], fraction)
        transl = self.poses.transl[first] + fraction * (self.poses.transl[second] - self.poses.transl[first])
        return axis_angle_from_quaternion(mixed), transl

    def vertices(self, times: np.ndarray) -> np.ndarray:
        """Body vertices (N, B, 3) [m] at times (N,) [s]; the last few are remembered."""
        times = np.atleast_1d(times)
        missing = [time for time in dict.fromkeys(times.tolist()) if time not in self._posed]
        if len(missing) > _REMEMBERED:
            return self.body.pose(*self.pose(times), self.betas)
        if missing:
            self._posed.update(zip(missing, self.body.pose(*self.pose(np.array(missing)), self.betas), strict=True))
        found = np.stack([self._posed[time] for time in times.tolist()])
        while len(self._posed) > _REMEMBERED:
            self._posed.popitem(last=False)
        return found

    def transforms(self, times: np.ndarray) -> np.ndarray:
        """Skinning transforms (N, V, 3, 4) of the garment's vertices at times (N,) [s], translation included."""
        poses, transl = self.pose(times)
        skeleton = joint_transforms(matrix_from_axis_angle(poses), self._joints, self.body.parents)
        blended = blend_transforms(self.garment.weights, skeleton)
        blended[..., 3] += transl[:, None]
        return blended

    def anchors(self, times: np.ndarray) -> np.ndarray:
        """The skinned garment template (N, V, 3) [m] at times (N,) [s]."""
        return skin(self.transforms(times), self.garment.vertices)

    def nearest(self, time: float, x: np.ndarray) -> NearestPoints:
        """Nearest points of the body surface at a time [s] for positions x (V, 3) [m]."""
        return nearest_on_surface(x, self.vertices(np.array([time]))[0], self.body.faces)

    def state(self, time: float, x: np.ndarray, dt: float, faces: np.ndarray | None = None) -> BodyState:
        """What positions x (V, 3) [m] see of the body at a time [s].

        The body's velocity is its displacement over the last ``dt`` seconds, as implicit Euler sees velocities.
        With ``faces`` (V,) the nearest points are sought on these triangles only.
        """
        now, before = self.vertices(np.array([time, time - dt]))
        return self._state(now, before, self.anchors(np.array([time]))[0], x, dt, faces)

    def states(self, times: np.ndarray, x: np.ndarray, dt: float, faces: np.ndarray | None = None) -> BodyState:
        """:meth:`state` at several times (N,) [s] for positions x (N, V, 3) [m]; faces (N, V) or none."""
        now, before = self.vertices(times), self.vertices(times - dt)
        each = [
            self._state(now[i], before[i], anchor, x[i], dt, None if faces is None else faces[i])
            for i, anchor in enumerate(self.anchors(times))
        ]
        fields = ("point", "normal", "velocity", "anchor")
        return BodyState(*(torch.stack([getattr(state, name) for state in each]) for name in fields))

    def nearest_faces(self, times: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The body triangle (N, V) nearest to each position x (N, V, 3) [m] at times (N,) [s]."""
        return np.stack([self.nearest(time, points).face for time, points in zip(times, x, strict=True)])

    def _state(
        self,
        now: np.ndarray,
        before: np.ndarray,
        anchor: np.ndarray,
        x: np.ndarray,
        dt: float,
        faces: np.ndarray | None,
    ) -> BodyState:
        triangles = self.body.faces
        found = nearest_on_surface(x, now, triangles) if faces is None else nearest_on_faces(x, now, triangles, faces)
        corners = triangles[found.face]
        earlier = np.einsum("vk,vkc->vc", found.barycentric, before[corners])
        velocity = (found.point - earlier) / dt
        return BodyState(*(torch.from_numpy(field) for field in (found.point, found.normal, velocity, anchor)))
