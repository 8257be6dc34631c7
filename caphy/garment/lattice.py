"""A flat cloth meshed anew by a finer lattice of triangles.

Hinges resist bending in all directions alike only where triangles are as good as equilateral (Seung and Nelson, Phys.
Rev. A 38, 1988). On squares with diagonals in turn, and still more where such faces are cut in four, bending across a
diagonal takes 1.5 to 1.8 times what it takes along a thread, and 3 times where all diagonals lie one way; a finer mesh
of that kind says of bending what no cloth does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import Delaunay, KDTree

from caphy.body.surface import nearest_on_surface
from caphy.garment.template import Garment
from caphy.garment.topology import boundary_edges, edges, face_areas

SHORTER = 0.6
"""Edges of the lattice over those that triangles as large as the coarse ones have if they are equilateral."""

_FLAT = 1e-3  # of an edge: how far from a plane, and rest shapes from one metric, cloth may be and count as flat
_EVEN = 3.0  # times: how much larger nearly all faces may be than others for one length of edge to suit all
_APART = 0.7  # of an edge: how near points of the lattice may be to the rim
_TURN = 0.45  # [rad] of the lattice, so that it lies along no threads
_ROUNDS = 30  # of evening out


@dataclass(frozen=True, eq=False)
class Lattice:
    """A flat garment and its lattice.

    Attributes:
        garment: the fine one.
        ends: of the coarse vertices in the middle of which each fine vertex lies (N, 2), both the same where it is one
            of them; -1 where it lies within a face.
    """

    garment: Garment
    ends: np.ndarray
    _onto_fine: tuple[np.ndarray, np.ndarray]  # corners (N, 3) and their weights
    _onto_coarse: tuple[np.ndarray, np.ndarray]

    shorter = SHORTER
    """Its edges over the coarse ones."""

    @classmethod
    def of(cls, coarse: Garment, fixed: np.ndarray | None = None) -> Lattice | None:
        """Skinning and attachment are interpolated. None where the cloth is not flat, its faces differ much in size, or
        a lattice would not keep its rim.

        Args:
            fixed: coarse vertices (V,) that must be among the fine ones, and the middles of edges between them.
        """
        plane = _plane(coarse)
        if plane is None:
            return None
        pairs, rim = edges(coarse.faces), boundary_edges(coarse.faces)
        held = np.zeros(len(coarse.vertices), bool) if fixed is None else fixed
        single = np.union1d(rim, np.flatnonzero(held))
        double = np.concatenate([np.sort(rim), pairs[held[pairs].all(axis=1)]])
        kept = np.concatenate([np.repeat(single, 2).reshape(-1, 2), np.unique(double, axis=0)])
        flat, metric = plane
        points = flat[kept].mean(axis=1)
        meshed = _meshed(flat, coarse.faces, points, rim)
        if meshed is None:
            return None
        points, faces = meshed
        found = nearest_on_surface(_lifted(points), _lifted(flat), coarse.faces)
        onto_fine = coarse.faces[found.face], found.barycentric
        back = nearest_on_surface(_lifted(flat), _lifted(points), faces)
        ends = np.full((len(points), 2), -1)
        ends[: len(kept)] = kept
        lies_by = coarse.faces[found.face, found.barycentric.argmax(axis=1)]
        in_all = np.where(found.barycentric > 1e-6, coarse.attached[onto_fine[0]], 1.0).min(axis=1)
        between = {n: _mixed(getattr(coarse, n), *onto_fine) for n in ("vertices", "weights", "layer_thickness")}
        garment = replace(
            coarse,
            faces=faces.astype(np.int32),
            material=points[faces] @ metric.T,
            regions=coarse.regions[lies_by],
            attached=in_all,
            **between,
        )
        return cls(garment, ends, onto_fine, (faces[back.face], back.barycentric))

    def carried(self, x: np.ndarray) -> np.ndarray:
        """A field (V, ...) of the coarse vertices on the fine ones (N, ...)."""
        return _mixed(x, *self._onto_fine)

    def seen(self, x: np.ndarray) -> np.ndarray:
        """A field (N, ...) of the fine vertices at the coarse ones (V, ...)."""
        return _mixed(x, *self._onto_coarse)


def _plane(garment: Garment) -> tuple[np.ndarray, np.ndarray] | None:
    """Coordinates (V, 2) [m] in the plane of a flat garment's rest shape, and what (2, 2) makes them material ones."""
    corner, area = garment.vertices[garment.faces], garment.rest_areas
    size = np.sqrt(area.mean())
    if np.quantile(area, 0.95) > _EVEN * np.quantile(area, 0.05):
        return None
    centred = garment.vertices - garment.vertices.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    if np.abs(centred @ axes[2]).max() > _FLAT * size:
        return None
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(axis=0)
    axes[1] *= np.sign(np.cross(axes[0], axes[1]) @ normal)
    flat = centred @ axes[:2].T
    if face_areas(flat, garment.faces).min() < _FLAT * size**2:
        return None
    sides, rest = (c[:, 1:] - c[:, :1] for c in (flat[garment.faces], garment.material))
    metric = np.linalg.solve(sides, rest)  # (F, 2, 2): sides @ metric = rest
    usual = np.median(metric, axis=0)
    if np.abs(sides @ usual - rest).max() > _FLAT * size:
        return None
    return flat, usual.T


def _meshed(
    flat: np.ndarray, faces: np.ndarray, kept: np.ndarray, rim: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Points (N, 2), the ``kept`` ones first, and faces of a lattice within a rim (R, 2) of edges."""
    total = float(face_areas(flat, faces).sum())
    edge = SHORTER * np.sqrt(total / len(faces) * 4 / np.sqrt(3))
    low, high = flat.min(axis=0), flat.max(axis=0)
    reach = int(np.linalg.norm(high - low) / edge) + 2
    i, j = np.meshgrid(np.arange(-reach, reach), np.arange(-reach, reach))
    turn = np.array([[np.cos(_TURN), np.sin(_TURN)], [-np.sin(_TURN), np.cos(_TURN)]])
    lattice = edge * np.stack([(i + 0.5 * j).ravel(), np.sqrt(0.75) * j.ravel()], 1) @ turn + (low + high) / 2
    lattice = lattice[((lattice > low) & (lattice < high)).all(axis=1)]
    inside = np.abs(nearest_on_surface(_lifted(lattice), _lifted(flat), faces).distance) < 1e-9
    lattice = lattice[inside]
    lattice = lattice[_from_rim(lattice, flat[rim]) > _APART * edge]
    lattice = lattice[KDTree(kept).query(lattice)[0] > _APART * edge]
    points = np.concatenate([kept, lattice])
    for _ in range(_ROUNDS):
        pairs = edges(_triangles(points))
        near, degree = np.zeros_like(points), np.bincount(pairs.ravel(), minlength=len(points))
        np.add.at(near, pairs, points[pairs[:, ::-1]])
        points[len(kept) :] = (near / degree[:, None])[len(kept) :]
    found = _triangles(points)
    middle = points[found].mean(axis=1)
    found = found[np.abs(nearest_on_surface(_lifted(middle), _lifted(flat), faces).distance) < 1e-9]
    whole = abs(face_areas(points, found).sum() / total - 1) < 1e-6 and len(np.unique(found)) == len(points)
    return (points, found) if whole and len(boundary_edges(found)) == 2 * len(rim) else None


def _triangles(points: np.ndarray) -> np.ndarray:
    """Delaunay triangles, counter-clockwise, without slivers along a straight rim."""
    faces = Delaunay(points).simplices
    a, b = (points[faces[:, k]] - points[faces[:, 0]] for k in (1, 2))
    doubled = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    faces = np.where(doubled[:, None] < 0, faces[:, ::-1], faces)
    return faces[np.abs(doubled) > 1e-6 * np.median(np.abs(doubled))]


def _from_rim(points: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Distance (N,) of points (N, 2) from the nearest of some edges (R, 2, 2)."""
    along = ends[:, 1] - ends[:, 0]
    away = points[:, None] - ends[:, 0]
    share = np.clip((away * along).sum(-1) / (along * along).sum(-1), 0, 1)
    return np.linalg.norm(away - share[..., None] * along, axis=-1).min(axis=1)


def _mixed(field: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nk...->n...", weights, field[corners])


def _lifted(flat: np.ndarray) -> np.ndarray:
    return np.column_stack([flat, np.zeros(len(flat))])
