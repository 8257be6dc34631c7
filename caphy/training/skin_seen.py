"""The body as cloth on it sees it in scored frames: by a tree on the CPU, in groups where a GPU trains."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caphy.body.grouped import GroupedSurface
from caphy.body.model import POSE_FEATURES, BodyModel
from caphy.body.skinning import blend_transforms, skin
from caphy.body.surface import Surface
from caphy.recorded import Recorded
from caphy.rotations import matrix_from_axis_angle
from caphy.training.in_threads import in_threads
from caphy.training.motions import Motions

Seen = tuple[Tensor, Tensor, Tensor]
"""Nearest point of the skin [m], its outward normal and its velocity [m/s], each (F, V, 3)."""


class ByTree:
    """What vertices see of the body, computed by the CPU's threads."""

    def __init__(self, body: BodyModel, betas: np.ndarray | None, template: Tensor) -> None:
        """``template`` (V, 3) [m]: the vertices on the body at rest."""
        rest = body.rest(betas)[0]
        self.body, self.betas, self.surface = body, betas, Surface.of(body.faces, rest)
        self._usual = self.surface.nearest(template.cpu().numpy(), rest).face  # a good guess all the time

    def __call__(self, motions: Motions, frames: np.ndarray, last: np.ndarray, x: Tensor, dt: float) -> Seen:
        """At x (F, V, 3) in ``frames`` (F,), the body moving since the frames ``last`` (F,), ``dt`` [s] before."""
        posed = np.concatenate([frames, last])
        bodies = self.body.pose(motions.poses[posed], motions.transl[posed], self.betas)
        now, earlier = bodies[: len(frames)], bodies[len(frames) :]
        points = x.cpu().numpy()
        result = np.empty((3, *points.shape), dtype=np.float32)

        def look(i: int) -> None:
            found = self.surface.nearest(points[i], now[i], self._usual)
            corners = earlier[i][self.surface.faces[found.face]]
            result[0, i], result[1, i] = found.point, found.normal
            result[2, i] = (found.point - np.einsum("vk,vkc->vc", found.barycentric, corners)) / dt

        in_threads(look, len(points))
        point, normal, velocity = torch.from_numpy(result).to(x)
        return point, normal, velocity


class InGroups:
    """The same, computed where the vertices are, in their precision."""

    def __init__(self, body: BodyModel, betas: np.ndarray | None, template: Tensor) -> None:
        rest, device = body.rest(betas)[0], template.device
        self.surface = GroupedSurface(Surface.of(body.faces, rest), device)
        self.rest, self.weights = (torch.from_numpy(part).to(template) for part in (rest, body.weights))
        self.correctives = None
        if body.posedirs is not None:
            self.correctives = torch.from_numpy(body.posedirs.reshape(-1, POSE_FEATURES).T).to(template)
        self._pose = Recorded(self._posed)

    def __call__(self, motions: Motions, frames: np.ndarray, last: np.ndarray, x: Tensor, dt: float) -> Seen:
        """As :class:`ByTree`."""
        posed = np.concatenate([frames, last])
        given = [motions.transforms[torch.from_numpy(posed)].to(x)]
        if self.correctives is not None:
            rotations = matrix_from_axis_angle(motions.poses[posed])[:, 1:] - np.eye(3)
            given.append(torch.from_numpy(rotations.reshape(len(posed), POSE_FEATURES)).to(x))
        (bodies,) = self._pose(*given)
        now, earlier = bodies[: len(frames)], bodies[len(frames) :]
        found = self.surface.nearest(x, now)
        corners = self.surface.faces[found.face].flatten(1)[..., None].expand(-1, -1, 3)
        before = (found.barycentric[..., None] * earlier.gather(1, corners).unflatten(1, (-1, 3))).sum(-2)
        return found.point, found.normal, (found.point - before) / dt

    def _posed(self, transforms: Tensor, feature: Tensor | None = None) -> tuple[Tensor]:
        """Vertices (F, V, 3) [m] of skinning transforms (F, 55, 3, 4) and, for correctives, R - I (F, 486)."""
        rest = self.rest
        if feature is not None and self.correctives is not None:
            rest = rest + (feature @ self.correctives).unflatten(1, rest.shape)
        return (skin(blend_transforms(self.weights, transforms), rest),)


def skin_seen(body: BodyModel, betas: np.ndarray | None, template: Tensor) -> ByTree | InGroups:
    """Whichever suits the device on which the template (V, 3) [m] lies."""
    return (ByTree if template.device.type == "cpu" else InGroups)(body, betas, template)
