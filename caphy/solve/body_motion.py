"""A body in motion as a garment sees it: nearest surface points, surface velocities and skinned anchors at any time."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch

from caphy.body.kinematics import joint_transforms
from caphy.body.model import BodyModel
from caphy.body.skinning import blend_transforms, skin
from caphy.body.surface import NearestPoints, Surface
from caphy.effects.base import BodyState
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.rotations import axis_angle_from_quaternion, matrix_from_axis_angle, quaternion_from_axis_angle
from caphy.solve.following import Following
from caphy.solve.paths import path

REACH = 0.05
"""Distance from the body beyond which a first guess ignores it [m]."""

CLEAR = 0.004
"""Distance from the body at which a first guess leaves cloth alone [m]."""

_REMEMBERED = 16  # posed bodies kept; a step asks for a few times, again and again
_SKELETONS = 2048  # kept of skeletons, 10 kB each: whoever rolls a motion out anew asks for the same times


_Skeleton = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Joint rotations, the skinning transforms that follow from them, and the root's translation [m]."""


class BodyMotion:
    """A body model moving through a pose sequence, and the garment worn on it.

    Time runs in seconds; before the first and after the last frame the body stands still. Between frames joint
    rotations and the root's translation follow splines (:mod:`caphy.solve.paths`), so that limbs keep their lengths.
    Everything is numpy float64 in the world frame (y up) except :class:`BodyState`, which is torch.

    Attributes:
        body, poses, garment: as given; ``poses`` with y up.
        fps: frames per second [Hz].
    """

    def __init__(
        self,
        body: BodyModel,
        poses: PoseSequence,
        garment: Garment,
        betas: np.ndarray | None = None,
        start: float = 0.0,
    ) -> None:
        """``betas`` (S,) is the body shape the garment was made on; the sequence's own betas are not used. ``start`` is
        the time of the first frame [s]."""
        self.body, self.garment, self.betas, self.start = body, garment, betas, start
        self._rest, self._joints = body.rest(betas)
        self.poses = poses.to_y_up(self._joints[0])
        self.fps = self.poses.fps
        self._turned = path(_unbroken(quaternion_from_axis_angle(self.poses.poses)), self.fps)
        self._moved = path(self.poses.transl, self.fps)
        self._still = Surface.of(body.faces, body.v_template)
        self._posed: OrderedDict[float, np.ndarray] = OrderedDict()
        self._skeletons: OrderedDict[float, _Skeleton] = OrderedDict()
        self.forget()

    def forget(self) -> None:
        """Forget what was asked for last, as if asked for the first time: of a point as near to two faces, which of
        them is told hangs on that, and rounding with it."""
        self._surface = Following(self._still)
        self._posed.clear()
        self._skeletons.clear()
        self._anchor_time, self._anchors = np.nan, self.garment.vertices

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.poses)

    @property
    def times(self) -> np.ndarray:
        """Times of the frames (T,) [s]."""
        return self.start + np.arange(len(self)) / self.fps

    def pose(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint rotations (N, 55, 3) [rad] and translations (N, 3) [m] at times (N,) [s]."""
        since = np.atleast_1d(times) - self.start
        turned = self._turned(since)
        turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
        return axis_angle_from_quaternion(turned), self._moved(since)

    def vertices(self, times: np.ndarray) -> np.ndarray:
        """Body vertices (N, B, 3) [m] at times (N,) [s]; the last few are remembered."""
        times = np.atleast_1d(times)
        missing = [time for time in dict.fromkeys(times.tolist()) if time not in self._posed]
        if len(missing) > _REMEMBERED:
            return self.body.pose(*self.pose(times), self.betas)
        if missing:
            rotations, transforms, transl = self._turns(np.array(missing))
            posed = self.body.skinned(self._rest, rotations, transforms) + transl[:, None]
            self._posed.update(zip(missing, posed, strict=True))
        found = np.stack([self._posed[time] for time in times.tolist()])
        while len(self._posed) > _REMEMBERED:
            self._posed.popitem(last=False)
        return found

    def transforms(self, times: np.ndarray) -> np.ndarray:
        """Skinning transforms (N, V, 3, 4) of the garment's vertices at times (N,) [s], translation included."""
        _, skeleton, transl = self._turns(np.atleast_1d(times))
        blended = blend_transforms(self.garment.weights, skeleton)
        blended[..., 3] += transl[:, None]
        return blended

    def _turns(self, times: np.ndarray) -> _Skeleton:
        """Rotations (N, 55, 3, 3), skinning transforms (N, 55, 3, 4) and translations (N, 3) at times (N,) [s]."""
        missing = [time for time in dict.fromkeys(times.tolist()) if time not in self._skeletons]
        if len(missing) > _REMEMBERED:
            return self._turned_at(times)
        if missing:
            self._skeletons.update(zip(missing, zip(*self._turned_at(np.array(missing)), strict=True), strict=True))
        rotations, transforms, transl = zip(*(self._skeletons[time] for time in times.tolist()), strict=True)
        while len(self._skeletons) > _SKELETONS:
            self._skeletons.popitem(last=False)
        return np.stack(rotations), np.stack(transforms), np.stack(transl)

    def _turned_at(self, times: np.ndarray) -> _Skeleton:
        poses, transl = self.pose(times)
        rotations = matrix_from_axis_angle(poses)
        return rotations, joint_transforms(rotations, self._joints, self.body.parents), transl

    def anchors(self, times: np.ndarray) -> np.ndarray:
        """The skinned garment template (N, V, 3) [m] at times (N,) [s]."""
        return skin(self.transforms(times), self.garment.vertices)

    def carried(self, x: np.ndarray, free: np.ndarray, start: float, stop: float) -> np.ndarray:
        """A guess (V, 3) [m] of where cloth will be at time ``stop`` [s].

        Cloth that touches the body at time ``start`` in positions x (V, 3) moves along with its limb; cloth farther
        away than :data:`REACH` goes where it would fly freely, ``free`` (V, 3); in between it does a bit of both. What
        would come nearer to the body than it was is put back to its distance.
        """
        before, after = self.transforms(np.array([start, stop]))
        turned = np.abs(np.linalg.det(before[..., :3])) > 0.1  # skinning collapses where joints fold up
        inverse = np.linalg.inv(np.where(turned[:, None, None], before[..., :3], np.eye(3)))
        rest = (inverse @ (x - before[..., 3])[..., None])[..., 0]
        along = np.where(turned[:, None], skin(after, rest), x + skin(after - before, self.garment.vertices))
        distance = self.nearest(start, x).distance
        near = np.clip(1 - np.abs(distance) / REACH, 0, 1)[:, None]
        guess = near * along + (1 - near) * free
        found = self.nearest(stop, guess)
        return guess + np.clip(np.minimum(distance, CLEAR) - found.distance, 0, None)[:, None] * found.normal

    def nearest(self, time: float, x: np.ndarray) -> NearestPoints:
        """Nearest points of the body surface at a time [s] for positions x (V, 3) [m]."""
        return self._surface.nearest(time, x, self.vertices(np.array([time]))[0])

    def state(self, time: float, x: np.ndarray, dt: float, lead: float = 0.0) -> BodyState:
        """What positions x (V, 3) [m] see of the body at a time [s].

        The body's velocity is what a step of ``dt`` seconds and a ``lead`` (:class:`caphy.effects.base.Step`) makes of
        its path, so that cloth which sticks to it stays where it sticks.
        """
        return self.seen(self.nearest(time, x), time, dt, lead)

    def seen(self, found: NearestPoints, time: float, dt: float, lead: float = 0.0) -> BodyState:
        """:meth:`state` for nearest points (V,) found already."""
        shares, times = set_out(time, dt, lead)
        before = np.tensordot(shares, self.vertices(times), 1)[self.body.faces[found.face]]
        velocity = (found.point - np.einsum("vk,vkc->vc", found.barycentric, before)) / dt
        fields = (found.point, found.normal, velocity, self._anchor(time))
        return BodyState(*(torch.from_numpy(field) for field in fields))

    def _anchor(self, time: float) -> np.ndarray:
        if time != self._anchor_time:
            self._anchor_time, self._anchors = time, self.anchors(np.array([time]))[0]
        return self._anchors


def set_out(time: float, dt: float, lead: float) -> tuple[np.ndarray, np.ndarray]:
    """Of what a path's origin is made in a step (:class:`caphy.effects.base.Step`): shares (N,) and times (N,) [s]."""
    if lead == 0:
        return np.ones(1), np.array([time - dt])
    return np.array([1 - lead, lead]), np.array([time - dt * (1 + lead), time - dt * lead])


def _unbroken(quaternions: np.ndarray) -> np.ndarray:
    """The same rotations (T, ..., 4) by quaternions that never change sides: q and -q are one rotation."""
    away = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) < 0
    return np.concatenate([quaternions[:1], quaternions[1:] * np.cumprod(np.where(away, -1.0, 1.0), axis=0)])
