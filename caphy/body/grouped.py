"""Exact nearest points of many frames at once, computed where the tensors are: for GPUs, which a tree does not suit.

Triangles or points that are neighbours form groups, each in a sphere. The group whose sphere is nearest gives every
point a first answer; then all groups are searched whose sphere reaches nearer than that. Nothing else can hold the
nearest, so the answers are those of :class:`caphy.body.surface.Surface` and of a k-d tree, in the tensors' precision.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from caphy.body.surface import NearestPoints, Surface
from caphy.body.triangle_tree import build_order

GROUP = 16
"""Triangles or points of a group, about."""
AT_ONCE = 1 << 22
"""Pairs of a point and a triangle or point that are held against each other at once: bounds memory."""
ON_SURFACE = 1e-6
"""Below this distance [m] the direction to the nearest point is rounding noise; the pseudonormal is answered."""


class GroupedSurface:
    """The faces of a :class:`Surface` in groups, for nearest points of B frames of moving vertices."""

    def __init__(self, surface: Surface, device: torch.device | str = "cpu") -> None:
        def tensor(values: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, dtype=np.int64)).to(device)

        bounds = _coarser(surface.bounds)
        self.faces, self.neighbours = tensor(surface.faces), tensor(surface.neighbours)
        self.members = tensor(surface.order[_places(bounds)])
        """Faces of each group, the last one repeated where there are fewer (G, M)."""

    def nearest(self, points: Tensor, vertices: Tensor) -> NearestPoints:
        """Nearest surface points of points (B, N, 3) [m], the surface's vertices being at (B, V, 3) in each frame.

        Every field of the answer is (B, N, ...), without gradient. Coordinates must be finite.
        """
        with torch.no_grad():
            return self._nearest(points, vertices)

    def _nearest(self, points: Tensor, vertices: Tensor) -> NearestPoints:
        middle = vertices.mean(1, keepdim=True)  # so that float32 resolves a body far from the origin as well
        points, vertices = points - middle, vertices - middle
        corners = vertices[:, self.faces]
        grouped = corners[:, self.members].flatten(0, 1)
        centres = grouped.mean((1, 2))
        radii = (grouped - centres[:, None, None]).square().sum(-1).amax((1, 2)).sqrt()

        def squares(group: Tensor, point: Tensor) -> Tensor:
            a, b, c = grouped[group].unbind(2)
            return _closest(point[:, None], a, b, c)[0]

        shape = len(points), len(self.members)
        _, member = _search(points, centres.view(*shape, 3), radii.view(shape), self.members.shape[1], squares)
        face = self.members.view(-1)[member]
        frame = torch.arange(len(points), device=points.device)[:, None]
        a, b, c = (corners[frame, face, corner] for corner in range(3))
        square, u, v, w = _closest(points, a, b, c)
        weights = torch.stack([u, v, w], -1)
        nearest = u[..., None] * a + v[..., None] * b + w[..., None] * c
        offset, outward = points - nearest, self._pseudonormals(corners, vertices, frame, face, weights)
        distance = square.sqrt().copysign((offset * outward).sum(-1))
        far = distance.abs() > ON_SURFACE
        normal = torch.where(far[..., None], offset / torch.where(far, distance, 1)[..., None], outward)
        return NearestPoints(face, weights, nearest + middle, normal, distance)

    def _pseudonormals(self, corners: Tensor, vertices: Tensor, frame: Tensor, face: Tensor, weights: Tensor) -> Tensor:
        """Unit normals (B, N, 3) of the faces, edges or vertices that the weights (B, N, 3) lie on."""
        a, b, c = corners.unbind(2)
        normals = _unit(torch.linalg.cross(b - a, c - a))
        around = torch.zeros_like(vertices)
        for i, (p, q, r) in enumerate(((a, b, c), (b, c, a), (c, a, b))):
            one, other = q - p, r - p
            angle = torch.atan2(torch.linalg.cross(one, other).norm(dim=-1), (one * other).sum(-1))
            around.index_add_(1, self.faces[:, i], normals * angle[..., None])
        none = weights == 0
        corner = self.faces[face].gather(-1, weights.argmax(-1, keepdim=True))[..., 0]
        across = self.neighbours[face].gather(-1, weights.argmin(-1, keepdim=True))[..., 0]
        own = normals[frame, face]
        edge = own + torch.where((across >= 0)[..., None], normals[frame, across], 0)
        zeros = none.sum(-1)[..., None]
        return _unit(torch.where(zeros == 2, around[frame, corner], torch.where(zeros == 1, edge, own)))


class GroupedClouds:
    """Clouds of points in groups, for the nearest of each to points of several frames."""

    def __init__(self, clouds: Sequence[np.ndarray], device: torch.device | str = "cpu") -> None:
        """``clouds``: points (N_i, 3) [m] each, numbered in the order given; one may be empty."""
        parts = [_grouped(np.asarray(cloud, dtype=np.float64)) for cloud in clouds]
        most, size = (max([1, *(part.shape[axis] for part in parts)]) for axis in (0, 1))
        points = np.zeros((len(parts), most, size, 3))
        radii = np.full((len(parts), most), -np.inf)
        for i, part in enumerate(parts):
            if len(part):
                points[i, : len(part)] = np.pad(part, ((0, 0), (0, size - part.shape[1]), (0, 0)), mode="edge")
                apart = points[i, : len(part)] - points[i, : len(part)].mean(1, keepdims=True)
                radii[i, : len(part)] = np.sqrt((apart**2).sum(-1).max(1))
        self.points, self.centres, self.radii = (
            torch.from_numpy(values).float().to(device) for values in (points, points.mean(2), radii)
        )
        """Points (C, G, M, 3) of each cloud's groups; centres (C, G, 3) and radii (C, G) of their spheres, [m]."""

    def nearest(self, points: Tensor, cloud: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (B, N) [m] and position (B, N, 3) of what lies nearest to points (B, N, 3) in the ``cloud`` (B,).

        Nothing carries a gradient. Coordinates must be finite. In an empty cloud everything is infinitely far.
        """
        with torch.no_grad():
            own = self.points[cloud].flatten(0, 1)

            def squares(group: Tensor, point: Tensor) -> Tensor:
                return (own[group] - point[:, None]).square().sum(-1)

            spheres = self.centres[cloud], self.radii[cloud]
            square, member = _search(points.detach(), *spheres, self.points.shape[2], squares)
            frame = torch.arange(len(points), device=points.device)[:, None]
            return square.sqrt(), own.view(len(points), -1, 3)[frame, member]


Squares = Callable[[Tensor, Tensor], Tensor]
"""Squared distances (P, M) [m^2] of the M members of groups (P,) from points (P, 3)."""


def _search(points: Tensor, centres: Tensor, radii: Tensor, size: int, squares: Squares) -> tuple[Tensor, Tensor]:
    """Squared distance (B, N) [m^2] of the nearest member and its place among a frame's groups laid end to end.

    points (B, N, 3); centres (B, G, 3) and radii (B, G) of the spheres of groups of ``size`` members, infinitely
    negative where there is no group. ``squares`` counts groups over all frames. Of members equally near the first is
    told, whatever the order in which a GPU works.
    """
    frames, count, groups = *points.shape[:2], centres.shape[1]
    reach = (points[..., 0, None] - centres[:, None, :, 0]).square_()
    for axis in (1, 2):
        apart = points[..., axis, None] - centres[:, None, :, axis]
        reach.addcmul_(apart, apart)
    reach = reach.sqrt_().sub_(radii[:, None]).view(-1, groups)
    points = points.reshape(-1, 3)
    of_frame = groups * torch.arange(frames, device=points.device).repeat_interleave(count)
    # One rounding error more, lest the sphere that holds the nearest be passed over
    bound = squares(of_frame + reach.argmin(1), points).amin(1).sqrt() * (1 + 1e-5) + 1e-6
    point, group = (reach < bound[:, None]).nonzero(as_tuple=True)
    step = max(AT_ONCE // size, 1)
    parts = zip(point.split(step), group.split(step), strict=True)
    found = [squares(of_frame[p] + g, points[p]).min(1) for p, g in parts]
    value = torch.cat([values for values, _ in found])
    member = group * size + torch.cat([places for _, places in found])
    best = value.new_full((len(points),), torch.inf).scatter_reduce_(0, point, value, "amin")
    won = value == best[point]
    none = groups * size
    winner = member.new_full((len(points),), none).scatter_reduce_(0, point[won], member[won], "amin")
    winner = torch.where(winner == none, 0, winner)  # of an empty cloud
    return best.view(frames, count), winner.view(frames, count)


def _closest(p: Tensor, a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Squared distance and three weights (...) of the point of triangle abc (..., 3) nearest to p (..., 3).

    As in :mod:`caphy.body.triangle_tree`: weights are exactly zero where the point lies on an edge or a corner.
    """
    ab, ac = b - a, c - a
    d1, d2, d3, d4, d5, d6 = (_dot(side, p - from_) for from_ in (a, b, c) for side in (ab, ac))
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    one, none = torch.ones_like(d1), torch.zeros_like(d1)
    v = torch.where((v_plus_w := va + vb + vc) > 0, vb / v_plus_w, none)
    w = torch.where(v_plus_w > 0, vc / v_plus_w, none)
    u = torch.where(v_plus_w > 0, (1 - v - w).clamp_min(0), one)
    along = (d4 - d3) / ((d4 - d3) + (d5 - d6))
    # From the last case of Ericson's to the first, so that the first that holds has the last word
    cases = (
        ((va <= 0) & (d4 >= d3) & (d5 >= d6) & ((d4 - d3) + (d5 - d6) > 0), none, 1 - along, along),
        ((vb <= 0) & (d2 >= 0) & (d6 <= 0) & (d2 > d6), 1 - (t := d2 / (d2 - d6)), none, t),
        ((d6 >= 0) & (d5 <= d6), none, none, one),
        ((vc <= 0) & (d1 >= 0) & (d3 <= 0) & (d1 > d3), 1 - (t := d1 / (d1 - d3)), t, none),
        ((d3 >= 0) & (d4 <= d3), none, one, none),
        ((d1 <= 0) & (d2 <= 0), one, none, none),
    )
    for holds, cu, cv, cw in cases:
        u, v, w = torch.where(holds, cu, u), torch.where(holds, cv, v), torch.where(holds, cw, w)
    apart = p - a - v[..., None] * ab - w[..., None] * ac
    return _dot(apart, apart), u, v, w


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _unit(x: Tensor) -> Tensor:
    return x / x.norm(dim=-1, keepdim=True).clamp_min(1e-30)


def _grouped(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) in groups of neighbours (G, M, 3), the last of a group repeated where it has fewer."""
    if not len(points):
        return np.zeros((0, 1, 3))
    leaves = 1 << max(-(-len(points) // GROUP) - 1, 0).bit_length()
    leaves = min(leaves, 1 << len(points).bit_length() - 1)
    order, bounds = build_order(points, leaves)
    return points[order[_places(bounds)]]


def _coarser(bounds: np.ndarray) -> np.ndarray:
    """Bounds of a tree's leaves at the level at which they hold a group, or as they are."""
    leaves = len(bounds) - 1
    while leaves > 1 and 2 * bounds[-1] <= GROUP * leaves:
        leaves //= 2
    return bounds[:: (len(bounds) - 1) // leaves]


def _places(bounds: np.ndarray) -> np.ndarray:
    """Places (G, M) of what lies between bounds (G + 1,), the last of a group repeated where it has fewer."""
    first, last = bounds[:-1, None], bounds[1:, None] - 1
    return np.minimum(first + np.arange((last - first).max() + 1), last)
