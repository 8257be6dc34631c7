"""How much cloth a scan shows over hung cloth: its area tells the girth of a garment, whatever the fabric.

Cloth that hangs is stretched by a percent, in folds or without. So the area that a scan shows, over that of the hung
garment in the same places, says how much wider the garment is, and neither stiffness nor where the body is found under
it enters. (How far cloth stands off the body depends on both.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.optimize import lsq_linear

from caphy.body.surface import nearest_on_surface
from caphy.garment.meshing import drop_unused
from caphy.garment.topology import boundary_edges, face_areas, face_normals
from caphy.register.chamfer import LABELS
from caphy.report.render import vertex_normals
from caphy.report.sight import ray_caster, visible
from caphy.scan.scan import Scan

EVENED, EDGE = 10, 0.006
"""Passes of Taubin's filter over scans with edges of EDGE [m], in proportion to the inverse of their square: a
millimetre of noise makes such a scan 5 % larger than what was scanned, 1 % after them, and folds stay."""
MOST_EVENED = 200
REACH = 0.05
"""How far scan and cloth may lie apart and be the same [m]."""
ROUGH, PATCH = 0.05, 0.01
"""Standard deviation of the share by which the area of a patch of so many square metres is wrong, and"""
RIM = 0.003
"""of the area of a part for where it ends [m^2]: a metre of rim, three millimetres off."""
ALIKE = 0.03
"""Share by which a part's area is wrong in all scans alike: they show 0.94 to 1.01 of what is seen of true cloth."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """A scan's cloth of one kind, noise evened out: vertices (V, 3) [m] and faces (F, 3)."""

    vertices: np.ndarray
    faces: np.ndarray

    @classmethod
    def of(cls, scan: Scan, kind: str) -> Sheet:
        """The ``upper`` or ``lower`` garment of a scan that has labels."""
        assert scan.labels is not None
        kept = (scan.labels[scan.faces] == LABELS[kind]).all(axis=1)
        mesh = trimesh.Trimesh(*drop_unused(scan.vertices, scan.faces), process=False)
        passes = round(EVENED * (EDGE / float(mesh.edges_unique_length.mean())) ** 2)
        trimesh.smoothing.filter_taubin(mesh, iterations=min(max(passes, 1), MOST_EVENED))
        return cls(*drop_unused(np.asarray(mesh.vertices), np.asarray(mesh.faces)[kept]))


@dataclass(frozen=True, eq=False)
class Shown:
    """Of each face of hung cloth, the area that is seen of it and the area of the scan over it (F,) [m^2]."""

    own: np.ndarray
    scanned: np.ndarray
    share: float
    """How much of the scan's cloth that is."""


def shown(
    vertices: np.ndarray, faces: np.ndarray, sheet: Sheet, others: Sequence[tuple[np.ndarray, np.ndarray]] = ()
) -> Shown:
    """What a scan shows of cloth at vertices (V, 3) [m] when ``others``, vertices and faces, stand in the way too.

    A place counts if the nearest one of the other surface is near, faces alike and is not on its rim: what lies over a
    hole of the scan, or beyond an end of either, has no counterpart. Rims themselves are left out for the same reason.
    And of hung cloth only what a camera could see counts: of what is folded into an armpit the scan has nothing, but it
    has cloth near it.
    """
    if len(sheet.faces) == 0:
        return Shown(np.zeros(len(faces)), np.zeros(len(faces)), 0.0)
    own, theirs = face_areas(vertices, faces), face_areas(sheet.vertices, sheet.faces)
    normals, their_normals = face_normals(vertices, faces), face_normals(sheet.vertices, sheet.faces)
    inside, their_inside = ~_on_rim(faces), ~_on_rim(sheet.faces)
    over = nearest_on_surface(sheet.vertices[sheet.faces].mean(axis=1), vertices, faces)
    under = nearest_on_surface(vertices[faces].mean(axis=1), sheet.vertices, sheet.faces)
    alike = (their_normals * normals[over.face]).sum(axis=1) > 0
    counts = (np.abs(over.distance) < REACH) & alike & inside[over.face] & their_inside
    seen = (np.abs(under.distance) < REACH) & ((normals * their_normals[under.face]).sum(axis=1) > 0)
    seen &= their_inside[under.face] & inside
    scanned = np.bincount(over.face[counts], theirs[counts], len(faces))
    own *= np.where(seen, _visible_shares(vertices, faces, others), 0.0)
    return Shown(own, scanned, float(theirs[counts].sum() / theirs.sum()))


def area_gains(vertices: np.ndarray, faces: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Growth of each face's area (F, K) [m^2] per unit of K eases that move vertices outwards by slopes (V, K)."""
    corners, normals = vertices[faces], face_normals(vertices, faces)
    outwards = vertex_normals(vertices, faces)[faces]
    opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    gradient = 0.5 * np.cross(normals[:, None], opposite)  # of the area, by each corner
    return np.einsum("fjc,fjc,fjk->fk", gradient, outwards, slopes[faces])


def eases_step(
    seen: Sequence[Shown],
    gains: np.ndarray,
    parts: np.ndarray,
    grown: np.ndarray,
    spread: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray] = (np.array(-np.inf), np.array(np.inf)),
) -> np.ndarray:
    """By how much eases (K,) must grow for each part of the cloth to have the area that scans show.

    Args:
        gains: growth of each face's area per unit of each ease (F, K).
        parts: number of the part (F,) that a face belongs to: a ring of cloth round one limb, for the nearest place of
            a fold may be any round that limb.
        grown: by how much each has grown already (K,).
        spread: standard deviation of what was known of each before (K,).
        limits: how far each may shrink and grow now (K,): where one ends at its limit the others do without it.
    """
    matrix, right = np.diag(1 / spread**2), -grown / spread**2
    for part in np.unique(parts):
        ring = parts == part
        # Summed over the scans: with an error that they share, differences between them would decide alone.
        own = np.array([each.own[ring].sum() for each in seen])
        lack = sum(each.scanned[ring].sum() for each in seen) - own.sum()
        slope = sum(gains[ring & (each.own > 0)].sum(axis=0) for each in seen)
        wrong = (ROUGH**2 * PATCH * own + RIM**2)[own > 0].sum() + (ALIKE * own.sum()) ** 2
        if wrong > 0:
            matrix += np.outer(slope, slope) / wrong
            right += slope * lack / wrong
    root = np.linalg.cholesky(matrix)
    return lsq_linear(root.T, np.linalg.solve(root, right), limits, method="bvls").x


def _on_rim(faces: np.ndarray) -> np.ndarray:
    """Which faces touch an open edge (F,)."""
    return np.asarray(np.isin(faces, boundary_edges(faces)).any(axis=1))


def _visible_shares(
    vertices: np.ndarray, faces: np.ndarray, others: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """How much of each face can be seen from outside (F,), told by three points of it."""
    rays, normals, corners = ray_caster([(vertices, faces), *others]), face_normals(vertices, faces), vertices[faces]
    middle = corners.mean(axis=1)
    return np.mean([visible((middle + corners[:, k]) / 2, normals, rays) for k in range(3)], axis=0)
