"""How far a garment's points lie from the cloth of scans, both ways, leaving out what the cameras could not see."""

from __future__ import annotations

from dataclasses import dataclass

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
CLOTH_POINTS, ALL_POINTS = 2000, 24000
"""Points that distances, and the borders of the cloth, are taken from."""


@dataclass(frozen=True, eq=False)
class Target:
    """One garment in one scan."""

    cloth: np.ndarray
    """Its points (N, 3) [m]."""
    everything: KDTree
    """Points of the whole scan."""
    labels: np.ndarray
    """Their labels."""
    kind: str
    cloth_tree: KDTree
    """All points of the cloth."""
    normals: np.ndarray
    """Their normals."""
    reach: float
    """How far aside of the nearest of them the cloth still goes on [m]."""
    placed: PlacedFigure
    """The body in this scan."""

    @classmethod
    def of(cls, cloud: Cloud, placed: PlacedFigure, kind: str) -> Target:
        """The cloth of a kind (``upper`` or ``lower``) in a cloud; an upper garment may hide a lower one."""
        mine = cloud.labels == LABELS[kind]
        own, thin = cloud.points[mine], cloud.thinned(ALL_POINTS)
        if len(own) < 2:
            raise CaphyError(
                f"{cloud.name}: has no points labelled {kind}; check its labels, or leave that garment out"
            )
        cloth, tree = own[even_sample(own, CLOTH_POINTS)] if len(own) > CLOTH_POINTS else own, KDTree(own)
        apart = np.quantile(tree.query(own[:: max(1, len(own) // 1000)], k=2)[0][:, 1], 0.9)
        return cls(
            cloth, KDTree(thin.points), thin.labels, kind, tree, cloud.normals[mine], ASIDE * float(apart), placed
        )

    def posed(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Points (N, 3) on the T-posed body, skinned with weights (N, 55) into this scan."""
        blend = np.tensordot(weights, self.placed.transforms, axes=1)
        return np.einsum("nij,nj->ni", blend[..., :3], points) + blend[..., 3] + self.placed.placement.transl

    def seen(self, posed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which posed points (N,) lie where the scan shows what is there, and which of them where it is this cloth.

        Nothing is known far from any point of the scan, nor for a lower garment where an upper one lies over it. Cloth
        is where its nearest point lies straight below or above, rather than aside, as it does beyond a hem.
        """
        distance, nearest = self.everything.query(posed)
        known = (distance < MOST) & ~((self.kind == "lower") & (self.labels[nearest] == UPPER))
        nearest = self.cloth_tree.query(posed)[1]
        offset = posed - self.cloth_tree.data[nearest]
        up = (offset * self.normals[nearest]).sum(axis=1)
        aside = np.sqrt(np.maximum((offset**2).sum(axis=1) - up**2, 0.0))
        return known, known & (np.abs(up) < MOST) & (aside < self.reach)

    def from_garment(self, posed: np.ndarray) -> np.ndarray:
        """Distance (N,) [m] of posed garment points from the cloth."""
        return np.minimum(self.cloth_tree.query(posed, distance_upper_bound=MOST)[0], MOST)

    def to_garment(self, posed: np.ndarray) -> float:
        """Mean distance [m] of the cloth from posed garment points (N, 3)."""
        return float(np.minimum(KDTree(posed).query(self.cloth, distance_upper_bound=MOST)[0], MOST).mean())
