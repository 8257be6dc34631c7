"""How far a garment's points lie from the cloth of scans, both ways, leaving out what the cameras could not see."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from caphy.errors import CaphyError
from caphy.register.articulation import PlacedFigure
from caphy.register.cloud import Cloud, even_sample
from caphy.scan.scan import LOWER, UPPER

LABELS = {"upper": UPPER, "lower": LOWER}
MOST = 0.08
"""Distance [m] beyond which points count no more."""
AROUND, FEW = 0.02, 2.5
"""Radius [m] of the patch of cloth that tells whether a place lies over it or beyond its edge; where points are few, in
distances to the next point (of which nine in ten are shorter)."""
EDGE = 4 / (3 * np.pi)
"""Distance of the middle of half a disc from that of the disc, in radii: so far aside lies the cloth at its edge."""
BESIDE = 3
"""Vertices of the body next to a place that are asked whether a shirt lies over it."""
CLOTH_POINTS, ALL_POINTS = 2000, 24000
"""Points that distances, and the borders of the cloth, are taken from."""


@dataclass(frozen=True, eq=False)
class Target:
    """One garment in one scan."""

    scan: Cloud
    """Points of the whole scan, thinned."""
    points: np.ndarray
    """All points of the cloth (M, 3) [m]."""
    normals: np.ndarray
    """Their normals."""
    kind: str
    placed: PlacedFigure
    """The body in this scan."""

    @classmethod
    def of(cls, cloud: Cloud, placed: PlacedFigure, kind: str) -> Target:
        """The cloth of a kind (``upper`` or ``lower``) in a cloud; an upper garment may hide a lower one."""
        mine = cloud.labels == LABELS[kind]
        if mine.sum() < 2:
            raise CaphyError(
                f"{cloud.name}: has no points labelled {kind}; check its labels, or leave that garment out"
            )
        return cls(cloud.thinned(ALL_POINTS), cloud.points[mine], cloud.normals[mine], kind, placed)

    @cached_property
    def cloth(self) -> np.ndarray:
        """Some of its points (N, 3) [m], spread evenly."""
        few = len(self.points) <= CLOTH_POINTS
        return self.points if few else self.points[even_sample(self.points, CLOTH_POINTS)]

    @cached_property
    def cloth_tree(self) -> KDTree:
        """All points of the cloth."""
        return KDTree(self.points)

    @cached_property
    def everything(self) -> KDTree:
        """Points of the whole scan."""
        return KDTree(self.scan.points)

    @cached_property
    def around(self) -> float:
        """Radius [m] of a patch of cloth with points enough to tell where its middle is."""
        some = self.points[:: max(1, len(self.points) // 1000)]
        return max(AROUND, FEW * float(np.quantile(self.cloth_tree.query(some, k=2)[0][:, 1], 0.9)))

    def posed(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Points (N, 3) on the T-posed body, skinned with weights (N, 55) into this scan."""
        blend = np.tensordot(weights, self.placed.transforms, axes=1)
        return np.einsum("nij,nj->ni", blend[..., :3], points) + blend[..., 3] + self.placed.placement.transl

    def seen(self, posed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which posed points (N,) lie where the scan shows what is there, and which of them where it is this cloth.

        Nothing is known far from any point of the scan, nor for a lower garment where an upper one lies over it, unless
        its cloth is seen there from below. Cloth is where the middle of what is near of it lies straight below or
        above, rather than aside, as it does beyond a hem.
        """
        distance, nearest = self.everything.query(posed)
        known = (distance < MOST) & ~((self.kind == "lower") & (self.scan.labels[nearest] == UPPER))
        offset, normal = self._nearby(posed)
        up = (offset * normal).sum(axis=1)
        aside = np.linalg.norm(offset - up[:, None] * normal, axis=1)
        cloth = known & (np.abs(up) < MOST) & (aside < EDGE * self.around)
        return known & (cloth | ~self._under(posed)), cloth

    def _nearby(self, posed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean offset (N, 3) [m] of posed points from the cloth near them, and its mean normal (N, 3).

        Of the nearest point alone neither tells: it is the one that noise has moved out most, aside by as much as the
        posed point lies high.
        """
        near = self.cloth_tree.query_ball_point(posed, np.hypot(self.cloth_tree.query(posed)[0], self.around))
        counts = np.array([len(each) for each in near])
        starts, points = np.cumsum(counts) - counts, np.concatenate(near).astype(int)
        places, normals = (
            np.add.reduceat(values[points], starts) / counts[:, None] for values in (self.points, self.normals)
        )
        return posed - places, normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12)

    def _under(self, posed: np.ndarray) -> np.ndarray:
        """Which posed points (N,) of a lower garment lie over a place of the body that an upper one lies over too.

        The nearest point of the scan does not tell: a shirt that stands off is farther away than the cloth below its
        hem.
        """
        if self.kind != "lower":
            return np.zeros(len(posed), bool)
        return self._shirt[self._skin.query(posed, k=BESIDE)[1]].any(axis=1)

    @cached_property
    def _skin(self) -> KDTree:
        """Vertices of the body."""
        return KDTree(self.placed.vertices)

    @cached_property
    def _shirt(self) -> np.ndarray:
        """Vertices of the body (V,) over which the scan shows an upper garment."""
        lain = np.zeros(len(self.placed.vertices), bool)
        lain[self._skin.query(self.scan.points[self.scan.labels == UPPER])[1]] = True
        return lain

    def from_garment(self, posed: np.ndarray) -> np.ndarray:
        """Distance (N,) [m] of posed garment points from the cloth."""
        return np.minimum(self.cloth_tree.query(posed, distance_upper_bound=MOST)[0], MOST)

    def to_garment(self, posed: np.ndarray) -> float:
        """Mean distance [m] of the cloth from posed garment points (N, 3)."""
        return float(np.minimum(KDTree(posed).query(self.cloth, distance_upper_bound=MOST)[0], MOST).mean())
