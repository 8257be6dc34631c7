"""How far a garment's points lie from the cloth of scans, both ways, leaving out what the cameras could not see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from caphy.register.articulation import PlacedFigure
from caphy.register.cloud import Cloud, even_sample
from caphy.scan.scan import LOWER, UPPER

LABELS = {"upper": UPPER, "lower": LOWER}
MOST = 0.08
"""Distance [m] beyond which points count no more."""
CLOTH_POINTS = 2000


@dataclass(frozen=True, eq=False)
class Target:
    """One garment in one scan."""

    cloth: np.ndarray
    """Its points (N, 3) [m]."""
    everything: KDTree
    """All points of the scan."""
    hidden: np.ndarray
    """Which of all points belong to what may be worn over it."""
    cloth_tree: KDTree
    placed: PlacedFigure
    """The body in this scan."""

    @classmethod
    def of(cls, cloud: Cloud, placed: PlacedFigure, kind: str) -> Target:
        """The cloth of a kind (``upper`` or ``lower``) in a cloud; an upper garment may hide a lower one."""
        own = cloud.points[cloud.labels == LABELS[kind]]
        thin = cloud.thinned(4 * CLOTH_POINTS)
        over = (thin.labels == UPPER) & (kind == "lower")
        cloth = own[even_sample(own, CLOTH_POINTS)] if len(own) > CLOTH_POINTS else own
        return cls(cloth, KDTree(thin.points), over, KDTree(own), placed)

    def posed(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Points (N, 3) on the T-posed body, skinned with weights (N, 55) into this scan."""
        blend = np.tensordot(weights, self.placed.transforms, axes=1)
        return np.einsum("nij,nj->ni", blend[..., :3], points) + blend[..., 3] + self.placed.placement.transl

    def from_garment(self, posed: np.ndarray) -> np.ndarray:
        """Distance (N,) [m] of posed garment points from the cloth; zero where another garment hides them."""
        distance = np.minimum(self.cloth_tree.query(posed, distance_upper_bound=MOST)[0], MOST)
        nearest = self.everything.query(posed)[1]
        return np.where(self.hidden[nearest], 0.0, distance)

    def to_garment(self, posed: np.ndarray) -> float:
        """Mean distance [m] of the cloth from posed garment points (N, 3)."""
        return float(np.minimum(KDTree(posed).query(self.cloth, distance_upper_bound=MOST)[0], MOST).mean())
