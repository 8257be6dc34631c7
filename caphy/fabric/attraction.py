"""Cloth drawn softly to scanned points, so that it lies in the folds that were scanned."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import coo_array, csr_array
from torch import Tensor

from caphy.body.surface import nearest_on_surface
from caphy.effects.base import Effect, Elements, Values
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential, Term, _incidence

TERM = "scan"
"""The attraction among a potential's terms; it is no effect of the cloth, so no registry knows it."""

ALIKE = 0.5
"""Cosine between a point's normal and the cloth's from which on they are the same side of the same fold."""

_RIM = 1e-9  # a weight below this puts a nearest point on the edge across


@dataclass(frozen=True, eq=False)
class Hits:
    """Scanned points and the places of the cloth's surface that each is held against, P of them.

    Attributes:
        index: which of the scan's points these are (P,).
        rows: (P, 3 V), a vertex field's component along the normal at each place.
        height: where each point is, in the same component (P,) [m].
        face, weights, normal: the places (P,), (P, 3) and directions (P, 3).
        area: of cloth that each point stands for (P,) [m^2].
    """

    index: np.ndarray
    rows: csr_array
    height: np.ndarray
    face: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    area: np.ndarray

    def __len__(self) -> int:
        """Number of points."""
        return len(self.height)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """How far each point lies outside the cloth at positions x (V, 3), along the normal (P,) [m]."""
        return self.height - self.rows @ x.ravel()


def find_hits(points: np.ndarray, facing: np.ndarray, x: np.ndarray, cloth: Cloth, reach: float) -> Hits:
    """Nearest places on the cloth at x (V, 3) of points (N, 3) within ``reach`` [m].

    Points nearest to a rim are left out: noise moves them beyond the cloth and never back, which would pull at hems.
    """
    found = nearest_on_surface(points, x, cloth.faces)
    near = (np.abs(found.distance) < reach) & ~_on_rim(cloth, found.face, found.barycentric)
    face, weights = found.face[near], found.barycentric[near]
    corners = cloth.faces[face]
    a, b, c = (x[corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-30)
    alike = np.einsum("pc,pc->p", normal, facing[near]) > ALIKE
    near[near] = alike
    face, weights, corners, normal = face[alike], weights[alike], corners[alike], normal[alike]
    entries = (weights[:, :, None] * normal[:, None]).reshape(len(face), 9)
    column = (3 * corners[:, :, None] + np.arange(3)).reshape(len(face), 9)
    row = np.repeat(np.arange(len(face)), 9).reshape(-1, 9)
    rows = coo_array((entries.ravel(), (row.ravel(), column.ravel())), (len(face), x.size)).tocsr()
    count = np.bincount(face, minlength=len(cloth.faces))
    area = (cloth.face_area / np.maximum(count, 1))[face]
    height = np.einsum("pc,pc->p", points[near], normal)
    return Hits(np.flatnonzero(near), rows, height, face, weights, normal, area)


def _on_rim(cloth: Cloth, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Whether places (P,) lie on an edge of one face only."""
    edges = np.sort(cloth.faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2)  # opposite to each corner
    _, which, count = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True, return_counts=True)
    rim = (count == 1)[which.ravel()].reshape(-1, 3)
    return (rim[face] & (weights < _RIM)).any(axis=1)


class _Attraction(Effect):
    """Springs along the normal, E = 1/2 x.M x - b.x of each face's nine coordinates; M and b come with the hits."""

    name = TERM
    element = "face"
    reference = "Chen, Medioni, Object modelling by registration of multiple range images, 1992 (point to plane)"

    def energy(self, e: Elements, p: Values) -> Tensor:
        return self.gradient(e, p)[0]

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        held = (e.rest["matrix"] * e.x).sum((2, 3))
        energy = (e.x * (0.5 * held - e.rest["pull"])).sum((0, 1)) + e.rest["constant"]
        return energy, held - e.rest["pull"]

    def hessian(self, e: Elements, p: Values) -> Tensor:
        return e.rest["matrix"]

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return e.rest["matrix"]


class AttractedPotential(Potential):
    """A model's potential with springs to scanned points beside it; :meth:`aim` says where they pull."""

    def __init__(self, model: Model, cloth: Cloth) -> None:
        super().__init__(model, cloth)
        index = torch.as_tensor(cloth.faces, dtype=torch.int64)
        self.terms[TERM] = Term(_Attraction(), index, _incidence(index, len(cloth.vertices)), {}, {})
        self.aim(None, 0.0)

    def aim(self, hits: Hits | None, strength: float) -> None:
        """Pull to hits with a strength [N/m^3]: pressure per distance; without hits nothing pulls."""
        count = len(self.cloth.faces)
        matrix, pull, constant = np.zeros((count, 9, 9)), np.zeros((count, 9)), np.zeros(count)
        if hits is not None and len(hits):
            spring = strength * hits.area
            entries = (hits.weights[:, :, None] * hits.normal[:, None]).reshape(-1, 9)
            np.add.at(matrix, hits.face, spring[:, None, None] * entries[:, :, None] * entries[:, None])
            np.add.at(pull, hits.face, (spring * hits.height)[:, None] * entries)
            np.add.at(constant, hits.face, 0.5 * spring * hits.height**2)
        fields = {"matrix": matrix.reshape(count, 3, 3, 3, 3), "pull": pull.reshape(count, 3, 3), "constant": constant}
        rest = {key: torch.from_numpy(np.ascontiguousarray(np.moveaxis(v, 0, -1))) for key, v in fields.items()}
        self.terms[TERM] = replace(self.terms[TERM], rest=rest)
