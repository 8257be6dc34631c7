"""Exact nearest points of many frames at once, computed where the tensors are: for GPUs, which a tree does not suit.

Triangles or points that are neighbours form groups, each in a sphere. The group whose sphere is nearest gives every
point a first answer; then all groups are searched whose sphere reaches nearer than that. Nothing else can hold the
nearest, so the answers are those of :class:`caphy.body.surface.Surface` and of a k-d tree, in the tensors' precision.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from caphy.body.surface import NearestPoints, Surface
from caphy.body.triangle_tree import build_order
from caphy.recorded import Recorded

GROUP = 16
"""Triangles or points of a group, about."""
AT_ONCE = 1 << 21
"""Pairs of a point and a triangle or point that are held against each other at once: bounds memory."""
ON_SURFACE = 1e-6
"""Below this distance [m] the direction to the nearest point is rounding noise; the pseudonormal is answered."""
ON_SIDE = 1e-6
"""Below this weight of the corner across from it a point lies on a side: what is left is rounding noise."""


class GroupedSurface:
    """The faces of a :class:`Surface` in groups, for nearest points of B frames of moving vertices."""

    def __init__(self, surface: Surface, device: torch.device | str = "cpu") -> None:
        def tensor(values: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, dtype=np.int64)).to(device)

        self.faces, self.neighbours = tensor(surface.faces), tensor(surface.neighbours)
        self.members = tensor(surface.order[_places(_coarser(surface.bounds))])
        """Faces of each group, the last one repeated where there are fewer (G, M)."""
        self._look_round, self._tell = Recorded(self._groups_in_reach), Recorded(self._on_faces)

    def nearest(self, points: Tensor, vertices: Tensor) -> NearestPoints:
        """Nearest surface points of points (B, N, 3) [m], the surface's vertices being at (B, V, 3) in each frame.

        Every field of the answer is (B, N, ...), without gradient. Coordinates must be finite.
        """
        centred, reached, *sides = self._look_round(points, vertices)
        member = _nearest_member(centred, reached, self.members.shape[1], partial(_squares, *sides))[1]
        return NearestPoints(*self._tell(points, vertices, self.members.view(-1)[member]))

    def _groups_in_reach(self, points: Tensor, vertices: Tensor) -> tuple[Tensor, ...]:
        """Points (B, N, 3) from the middle of their frame, the groups (B, N, G) in reach, and the sides of faces."""
        middle = vertices.mean(1, keepdim=True)  # so that single precision resolves a body far from the origin as well
        points, corners = points - middle, (vertices - middle)[:, self.faces]
        sides = tuple(part[:, self.members].flatten(0, 1) for part in _sides(corners))
        grouped = sides[0]
        centres = grouped.mean((1, 2))
        radii = (grouped - centres[:, None, None]).square().sum(-1).amax((1, 2)).sqrt()
        shape = len(points), len(self.members)
        spheres = centres.view(*shape, 3), radii.view(shape)
        return points, _in_reach(points, *spheres, partial(_squares, *sides)), *sides

    def _on_faces(self, points: Tensor, vertices: Tensor, face: Tensor) -> tuple[Tensor, ...]:
        """The fields of :class:`NearestPoints` on given faces (B, N)."""
        middle = vertices.mean(1, keepdim=True)
        points, vertices = points - middle, vertices - middle
        corners, frame = vertices[:, self.faces], torch.arange(len(points), device=points.device)[:, None]
        own = corners[frame, face]
        weights = _barycentric(points, *own.unbind(2))
        nearest = (weights[..., None] * own).sum(-2)
        offset = points - nearest
        outward = self._pseudonormals(corners, vertices, frame, face, weights)
        distance = _dot(offset, offset).sqrt().copysign(_dot(offset, outward))
        far = distance.abs() > ON_SURFACE
        normal = torch.where(far[..., None], offset / torch.where(far, distance, 1)[..., None], outward)
        return face, weights, nearest + middle, normal, distance

    def _pseudonormals(self, corners: Tensor, vertices: Tensor, frame: Tensor, face: Tensor, weights: Tensor) -> Tensor:
        """Unit normals (B, N, 3) of the faces, edges or vertices that the weights (B, N, 3) lie on."""
        a, b, c = corners.unbind(2)
        normals = _unit(torch.linalg.cross(b - a, c - a))
        around = torch.zeros_like(vertices)
        for i, (p, q, r) in enumerate(((a, b, c), (b, c, a), (c, a, b))):
            one, other = q - p, r - p
            angle = torch.atan2(torch.linalg.cross(one, other).norm(dim=-1), (one * other).sum(-1))
            around.index_add_(1, self.faces[:, i], normals * angle[..., None])
        none = weights < ON_SIDE
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
        self._look_round = Recorded(self._groups_in_reach)

    def nearest(self, points: Tensor, cloud: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (B, N) [m] and position (B, N, 3) of what lies nearest to points (B, N, 3) in the ``cloud`` (B,).

        Nothing carries a gradient. Coordinates must be finite. In an empty cloud everything is infinitely far.
        """
        points = points.detach()
        reached, own = self._look_round(points, cloud)
        square, member = _nearest_member(points, reached, self.points.shape[2], partial(_squares_of_points, own))
        frame = torch.arange(len(points), device=points.device)[:, None]
        return square.sqrt(), own.view(len(points), -1, 3)[frame, member]

    def _groups_in_reach(self, points: Tensor, cloud: Tensor) -> tuple[Tensor, Tensor]:
        own = self.points[cloud].flatten(0, 1)
        return _in_reach(points, self.centres[cloud], self.radii[cloud], partial(_squares_of_points, own)), own


Squares = Callable[[Tensor, Tensor], Tensor]
"""Squared distances (P, M) [m^2] of the M members of groups (P,), counted over all frames, from points (P, 3)."""


def _in_reach(points: Tensor, centres: Tensor, radii: Tensor, squares: Squares) -> Tensor:
    """Which groups (B, N, G) may hold what is nearest to points (B, N, 3); at least those that do.

    centres (B, G, 3) and radii (B, G): the groups' spheres, infinitely negative where there is no group.
    """
    count, groups = points.shape[1], centres.shape[1]
    reach = (points[..., 0, None] - centres[:, None, :, 0]).square_()
    for axis in (1, 2):
        apart = points[..., axis, None] - centres[:, None, :, axis]
        reach.addcmul_(apart, apart)
    reach = reach.sqrt_().sub_(radii[:, None])
    first = reach.argmin(2) + groups * torch.arange(len(points), device=points.device)[:, None]
    found = squares(first.view(-1), points.reshape(-1, 3)).amin(1).sqrt().view(-1, count, 1)
    # One rounding error more, lest the sphere that holds the nearest be passed over
    return reach < found * (1 + 1e-5) + 1e-6


def _nearest_member(points: Tensor, reached: Tensor, size: int, squares: Squares) -> tuple[Tensor, Tensor]:
    """Squared distance (B, N) [m^2] of the nearest member and its place among a frame's groups laid end to end.

    ``reached`` (B, N, G): the groups to look through, of ``size`` members. Of members equally near the first is told,
    whatever the order in which a GPU works. Where no group is reached everything is infinitely far.
    """
    frames, count, groups = reached.shape
    point, group = reached.view(-1, groups).nonzero(as_tuple=True)
    points, counted = points.reshape(-1, 3), group + point.div(count, rounding_mode="floor") * groups
    step = max(AT_ONCE // size, 1)
    parts = zip(point.split(step), counted.split(step), strict=True)
    found = [squares(g, points[p]).min(1) for p, g in parts]
    value = torch.cat([values for values, _ in found])
    member = group * size + torch.cat([places for _, places in found])
    best = value.new_full((len(points),), torch.inf).scatter_reduce_(0, point, value, "amin")
    none = groups * size
    own = torch.where(value == best[point], member, none)
    winner = member.new_full((len(points),), none).scatter_reduce_(0, point, own, "amin")
    winner = torch.where(winner == none, 0, winner)
    return best.view(frames, count), winner.view(frames, count)


def _squares_of_points(grouped: Tensor, group: Tensor, point: Tensor) -> Tensor:
    """As :data:`Squares`, of points (P, M, 3)."""
    return (grouped[group] - point[:, None]).square().sum(-1)


def _sides(corners: Tensor) -> tuple[Tensor, ...]:
    """Of triangles (..., 3, 3) their corners, the sides that begin there, the inverse squares of the sides' lengths
    (..., 3), the directions inwards across the sides, and the unit normal (..., 3); zeros where there is no area."""
    along = corners.roll(-1, -2) - corners
    square = _dot(along, along)
    normal = _unit(torch.linalg.cross(along[..., 0, :], along[..., 1, :]))
    return (
        corners,
        along,
        torch.where(square > 0, 1 / square, 0),
        torch.linalg.cross(normal[..., None, :], along),
        normal,
    )


def _squares(
    corners: Tensor, along: Tensor, inverse: Tensor, inwards: Tensor, normal: Tensor, group: Tensor, point: Tensor
) -> Tensor:
    """As :data:`Squares`, of triangles as :func:`_sides` tells them: from the plane inside, else from the sides."""
    from_corner = point[:, None, None] - corners[group]
    side = along[group]
    beside = from_corner - side * ((from_corner * side).sum(-1) * inverse[group]).clamp_(0, 1)[..., None]
    inside = ((from_corner * inwards[group]).sum(-1) > 0).all(-1)
    height = (from_corner[..., 0, :] * normal[group]).sum(-1)
    return torch.where(inside, height.square(), beside.square().sum(-1).amin(-1))


def _barycentric(p: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Weights (..., 3) of the point of triangle abc nearest to p: the inside solution, else the best edge's."""
    ab, ac, ap = b - a, c - a, p - a
    d00, d01, d11 = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    scale = d00 * d11 - d01 * d01
    flat = scale <= 0
    scale = torch.where(flat, torch.ones_like(scale), scale)
    v, w = (d11 * d20 - d01 * d21) / scale, (d00 * d21 - d01 * d20) / scale
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & ~flat
    best, best_square = torch.stack([1 - v - w, v, w], dim=-1), None
    for i, j, start, along in ((0, 1, a, ab), (1, 2, b, c - b), (2, 0, c, -ac)):
        length = _dot(along, along)
        t = _dot(p - start, along) / torch.where(length > 0, length, torch.ones_like(length))
        t = torch.minimum(torch.maximum(t, torch.zeros_like(t)), torch.ones_like(t))  # a clip waits for a GPU
        offset = p - start - t[..., None] * along
        square = _dot(offset, offset)
        columns = [torch.zeros_like(t)] * 3
        columns[i], columns[j] = 1 - t, t
        edge = torch.stack(columns, dim=-1)
        better = ~inside if best_square is None else ~inside & (square < best_square)
        best_square = square if best_square is None else torch.minimum(square, best_square)
        best = torch.where(better[..., None], edge, best)
    return best


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
