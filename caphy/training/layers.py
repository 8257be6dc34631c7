"""Contact between garments worn one over the other (CaPhy, section 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from caphy.body.surface import Surface
from caphy.effects.body_contact import penalty
from caphy.effects.cloth import Cloth

STIFFNESS = 1e8
"""Pressure per squared depth, over three [N/m^4]: that of contact with the body."""
GAP = 0.004
"""Distance below which two layers push each other apart [m]; they come to rest just inside."""
NEIGHBOURHOOD = 0.10
"""Two places of two garments may meet if they lie within this of each other at rest on the T-posed body [m].

It leaves out what only meets where the body meets itself, as a sleeve on a hip or a shirt's front on a raised thigh:
there is no room to make."""
REACH = 0.04
"""Cloth farther than this behind the other garment belongs to another side of the body [m]."""
ON_EDGE = 1e-6
"""Barycentric weight that counts as none."""


class Side(NamedTuple):
    """Vertices of one garment as they lie to the surface of the other, in one frame."""

    vertex: np.ndarray
    """Which vertices (N,)."""
    corners: np.ndarray
    """Corners of the nearest face (N, 3)."""
    share: np.ndarray
    """Barycentric weights of the nearest point (N, 3)."""
    normal: np.ndarray
    """Outward unit normal there (N, 3)."""
    height: np.ndarray
    """How far the outer garment is outside the inner one here (N,) [m]; negative where they have changed places."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two garments, one worn over the other, and where they can meet."""

    inner: Cloth
    outer: Cloth
    surfaces: tuple[Surface, Surface]
    """Of the inner and of the outer garment."""
    near: tuple[np.ndarray, np.ndarray]
    """Vertices of the inner and of the outer garment that may meet the other."""
    rims: tuple[np.ndarray, np.ndarray]
    """Whether each vertex of the inner and of the outer garment lies on an open edge."""

    @classmethod
    def of(cls, inner: Cloth, outer: Cloth) -> Pair:
        """Garments as they lie on the T-posed body."""
        surfaces = Surface.of(inner.faces, inner.vertices), Surface.of(outer.faces, outer.vertices)
        near = (_near(inner, surfaces[1], outer), _near(outer, surfaces[0], inner))
        rims = (_rim(surfaces[0], len(inner.vertices)), _rim(surfaces[1], len(outer.vertices)))
        return cls(inner, outer, surfaces, near, rims)

    def sides(self, inner: np.ndarray, outer: np.ndarray) -> tuple[Side, Side]:
        """Outer vertices (V, 3) over the inner surface, and inner vertices (W, 3) under the outer one [m].

        Only where they meet: the nearest point lies within reach, near it at rest too, and on no open edge, beyond
        which there is nothing to be outside of.
        """
        over = _side(outer, self.near[1], inner, self.surfaces[0], self.rims[0], 1.0)
        under = _side(inner, self.near[0], outer, self.surfaces[1], self.rims[1], -1.0)
        return _neighbours(over, self.outer, self.inner), _neighbours(under, self.inner, self.outer)

    def energy(self, inner: Tensor, outer: Tensor) -> Tensor:
        """Energy [J] of one frame, vertices (W, 3) and (V, 3), differentiable in both.

        k a d^3 of each vertex with d = max(gap - height, 0) and a its rest area, on along its tangent where the two
        have changed places, as :class:`caphy.effects.body_contact.BodyContact`: a steeper push there makes the few
        deepest vertices throw the networks off. The height's gradient is the normal at the vertex, and minus it,
        shared out, at the corners of the face. (CaPhy's equation is printed with the opposite sign, which would pull
        the layers into each other.)
        """
        still = (x.detach().cpu().double().numpy() for x in (inner, outer))
        over, under = self.sides(*still)
        return _push(over, outer, inner, 1.0, self.outer) + _push(under, inner, outer, -1.0, self.inner)

    def depths(self, inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
        """How deep each vertex that meets the other garment lies on its wrong side [m]; negative on the right one."""
        return np.concatenate([-side.height for side in self.sides(inner, outer)])


class Layers:
    """Garments worn one over the other, any two of which may touch."""

    def __init__(self, cloths: Sequence[Cloth]) -> None:
        """``cloths`` from the inside out."""
        self.pairs = {(i, j): Pair.of(cloths[i], cloths[j]) for i, j in combinations(range(len(cloths)), 2)}

    def __call__(self, frames: Sequence[Tensor]) -> Tensor:
        """Energy (B, K) [J] of the garments' vertices (B, K, V, 3) [m], from the inside out."""
        flat = [x.flatten(0, 1) for x in frames]
        energies = [
            sum(pair.energy(flat[i][f], flat[j][f]) for (i, j), pair in self.pairs.items()) for f in range(len(flat[0]))
        ]
        return torch.stack([frames[0].new_zeros(()) + energy for energy in energies]).unflatten(0, frames[0].shape[:2])

    def depths(self, vertices: Sequence[np.ndarray]) -> np.ndarray:
        """Depths [m] of all vertices that meet another garment, in one frame; see :meth:`Pair.depths`."""
        return np.concatenate([pair.depths(vertices[i], vertices[j]) for (i, j), pair in self.pairs.items()])


def _near(mine: Cloth, surface: Surface, other: Cloth) -> np.ndarray:
    return np.flatnonzero(np.abs(surface.nearest(mine.vertices, other.vertices).distance) < NEIGHBOURHOOD)


def _rim(surface: Surface, count: int) -> np.ndarray:
    rim = np.zeros(count, dtype=bool)
    face, corner = np.nonzero(surface.neighbours < 0)
    for along in (1, 2):
        rim[surface.faces[face, (corner + along) % 3]] = True
    return rim


def _side(x: np.ndarray, near: np.ndarray, others: np.ndarray, surface: Surface, rim: np.ndarray, sign: float) -> Side:
    found = surface.nearest(x[near], others)
    corners, share = surface.faces[found.face], np.asarray(found.barycentric)
    on_edge = ((share < ON_EDGE) & (surface.neighbours[found.face] < 0)).any(axis=1)
    on_rim = ((share > 1 - ON_EDGE) & rim[corners]).any(axis=1)
    meets = ~(on_edge | on_rim) & (np.abs(found.distance) < REACH)
    parts = (near, corners, share, found.normal, sign * np.asarray(found.distance))
    return Side(*(np.asarray(part)[meets] for part in parts))


def _neighbours(side: Side, mine: Cloth, others: Cloth) -> Side:
    """Those that lie near each other at rest."""
    point = np.einsum("nk,nkc->nc", side.share, others.vertices[side.corners])
    near = np.linalg.norm(mine.vertices[side.vertex] - point, axis=1) < NEIGHBOURHOOD
    return Side(*(part[near] for part in side))


def _push(side: Side, x: Tensor, others: Tensor, sign: float, cloth: Cloth) -> Tensor:
    """Energy [J] of vertices x (V, 3) at the surface whose vertices are ``others`` (W, 3)."""

    def tensor(values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(x)

    close = side.height < GAP
    vertex, corners = (torch.from_numpy(index[close]).to(x.device) for index in (side.vertex, side.corners))
    point = (tensor(side.share[close])[..., None] * others[corners]).sum(-2)
    height = sign * (tensor(side.normal[close]) * (x[vertex] - point)).sum(-1)
    area = tensor(cloth.vertex_area[side.vertex[close]])
    skin = torch.full_like(height, GAP)
    return STIFFNESS * (area * penalty((GAP - height).clamp_min(0), skin)).sum()
