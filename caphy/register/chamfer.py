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
ASIDE = 0.75
"""How far cloth goes on beside its points, in distances to the next point (of which nine in ten are shorter).

With points strewn at random, half of those just at an edge lie within it: garments come out neither long nor short."""
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
    def reach(self) -> float:
        """How far aside of the nearest of its points the cloth still goes on [m]."""
        some = self.points[:: max(1, len(self.points) // 1000)]
        return ASIDE * float(np.quantile(self.cloth_tree.query(some, k=2)[0][:, 1], 0.9))

    def posed(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Points (N, 3) on the T-posed body, skinned with weights (N, 55) into this scan."""
        blend = np.tensordot(weights, self.placed.transforms, axes=1)
        return np.einsum("nij,nj->ni", blend[..., :3], points) + blend[..., 3] + self.placed.placement.transl

    def seen(self, posed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which posed points (N,) lie where the scan shows what is there, and which of them where it is this cloth.

        Nothing is known far from any point of the scan, nor for a lower garment where an upper one lies over it, unless
        its cloth is seen there from below. Cloth is where its nearest point lies straight below or above, rather than
        aside, as it does beyond a hem.
        """
        distance, nearest = self.everything.query(posed)
        known = (distance < MOST) & ~((self.kind == "lower") & (self.scan.labels[nearest] == UPPER))
        nearest = self.cloth_tree.query(posed)[1]
        offset = posed - self.cloth_tree.data[nearest]
        up = (offset * self.normals[nearest]).sum(axis=1)
        aside = np.sqrt(np.maximum((offset**2).sum(axis=1) - up**2, 0.0))
        cloth = known & (np.abs(up) < MOST) & (aside < self.reach)
        return known & (cloth | ~self._under(posed)), cloth

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
