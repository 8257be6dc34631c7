"""Two-sided distance between the clothes of a scan and predicted ones.

POP (Ma et al., ICCV 2021), whose definition CaPhy follows, adds two means of squared distances: from each predicted
point to the scan, measured to the scan's surface, and from each point of the scan to its nearest predicted point. Here
both go to the nearest point of the other's triangles, so that the density of samples does not enter. CaPhy's table is
in millimetres and does not say how squares become lengths: ``root`` is the square root of half of POP's sum. It is
never less than ``mean``, half the sum of the mean distances, which other papers call Chamfer distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from caphy.body.surface import Surface
from caphy.errors import CaphyError
from caphy.evaluate.dressed import Dressed
from caphy.report.render import vertex_normals
from caphy.report.sight import visible
from caphy.scan.scan import LABEL_NAMES, Scan

SAMPLES: Final = 12_000
"""Points on predicted garments, those nobody can see among them."""
LEAST_FACES: Final = 50
"""Triangles of clothes below which there is nothing to compare with."""


@dataclass(frozen=True)
class Chamfer:
    """Mean distances [m] and mean squared distances [m^2] of predicted points to the scan and back."""

    to_scan: float
    from_scan: float
    to_scan_square: float
    from_scan_square: float

    @property
    def pop(self) -> float:
        """POP's sum of both mean squares [m^2]."""
        return self.to_scan_square + self.from_scan_square

    @property
    def root(self) -> float:
        """Root of half of POP's sum [m]."""
        return float(np.sqrt(0.5 * self.pop))

    @property
    def mean(self) -> float:
        """Half the sum of both mean distances [m]."""
        return 0.5 * (self.to_scan + self.from_scan)


@dataclass(frozen=True, eq=False)
class ScanCloth:
    """The clothes of one labelled scan."""

    points: np.ndarray
    """(N, 3) [m]."""
    faces: np.ndarray
    """(F, 3) of them."""

    @classmethod
    def of(cls, scan: Scan, kinds: tuple[str, ...]) -> ScanCloth:
        """What is labelled as one of ``kinds``.

        Raises:
            CaphyError: the scan has no labels, or shows too little of these clothes.
        """
        if scan.labels is None:
            raise scan.error("has no labels; make them with 'caphy segment'")
        cloth = np.isin(scan.labels, [LABEL_NAMES.index(kind) for kind in kinds])
        faces = scan.faces[cloth[scan.faces].all(axis=1)]
        if len(faces) < LEAST_FACES:
            raise scan.error(
                f"shows no {' or '.join(kinds)} garment: it must have {LEAST_FACES} triangles with that label, got "
                f"{len(faces)}; check its labels"
            )
        used, corners = np.unique(faces, return_inverse=True)
        return cls(scan.vertices[used], corners.reshape(-1, 3))

    @cached_property
    def surface(self) -> Surface:
        """Its triangles, ready for nearest-point queries."""
        return Surface.of(self.faces, self.points)

    def chamfer(self, dressed: Dressed, kinds: tuple[str, ...]) -> Chamfer:
        """How far the garments ``kinds`` of a prediction lie from this cloth, and it from them."""
        meshes = [dressed.garments[kind] for kind in kinds]
        starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
        vertices = np.concatenate([vertices for vertices, _ in meshes])
        faces = np.concatenate([faces + start for (_, faces), start in zip(meshes, starts, strict=False)])
        there = np.abs(self.surface.nearest(visible_points(dressed, vertices, faces), self.points).distance)
        back = np.abs(Surface.of(faces, vertices).nearest(self.points, vertices).distance)
        return Chamfer(*(float(v) for v in (there.mean(), back.mean(), (there**2).mean(), (back**2).mean())))


def visible_points(dressed: Dressed, vertices: np.ndarray, faces: np.ndarray, seed: int = 0) -> np.ndarray:
    """Points (N, 3) [m] spread evenly over a mesh of ``dressed``, without those that no scanner round it could see.

    A point is seen if its outer side can be looked at with no body or cloth in between.

    Raises:
        CaphyError: nothing of it can be seen.
    """
    points, normals = surface_samples(vertices, faces, SAMPLES, seed)
    seen = visible(points, normals, dressed.caster)
    if not seen.any():
        raise CaphyError("nothing of the predicted garments can be seen from outside: they lie within the body")
    return points[seen]


def surface_samples(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """``count`` points (count, 3) drawn evenly from a mesh's area, and the outward unit normals there."""
    random = np.random.default_rng(seed)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not areas.sum() > 0:
        raise CaphyError("a garment without any area has no surface to sample")
    face = random.choice(len(faces), count, p=areas / areas.sum())
    shares = random.dirichlet(np.ones(3), count)
    points = np.einsum("nk,nkc->nc", shares, vertices[faces[face]])
    normals = np.einsum("nk,nkc->nc", shares, vertex_normals(vertices, faces)[faces[face]])
    return points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
