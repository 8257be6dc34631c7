"""What the fit sees of one scan: oriented points, each known to be skin or cloth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.scan.scan import BODY, LOWER, UPPER, Scan


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a scan's surface with outward normals and labels."""

    name: str
    points: np.ndarray
    """(N, 3) [m], y up."""
    normals: np.ndarray
    """Outward unit normals (N, 3)."""
    labels: np.ndarray
    """(N,): :data:`caphy.scan.scan.BODY`, ``UPPER`` or ``LOWER``."""

    @classmethod
    def of(cls, scan: Scan) -> Cloud:
        """The labelled vertices of a scan that lie on faces.

        Raises:
            CaphyError: the scan has no labels, too little skin or cloth to fit to, or its normals point inward.
        """
        if scan.labels is None:
            raise scan.error("has no labels; make them with 'caphy segment'")
        used = np.isin(scan.labels, (BODY, UPPER, LOWER)) & (np.linalg.norm(scan.normals, axis=1) > 0.5)
        cloud = cls(scan.name, scan.vertices[used], scan.normals[used], scan.labels[used])
        counts = {name: int((cloud.labels == label).sum()) for name, label in (("body", BODY),)}
        counts["cloth"] = len(cloud.points) - counts["body"]
        for name, count in counts.items():
            if count < LEAST_POINTS:
                raise scan.error(
                    f"must have at least {LEAST_POINTS} vertices labelled {name}, got {count}; check its labels, or "
                    "leave the scan out"
                )
        if _inward(cloud):
            raise scan.error("its normals point inward; turn its faces over in a mesh editor")
        return cloud

    @property
    def skin(self) -> np.ndarray:
        """Which points are bare skin (N,)."""
        return self.labels == BODY

    def thinned(self, count: int, seed: int = 0) -> Cloud:
        """About ``count`` points spread evenly: one at random from each cell of a grid that gives so many."""
        if len(self.points) <= count:
            return self
        kept = even_sample(self.points, count, seed)
        return Cloud(self.name, self.points[kept], self.normals[kept], self.labels[kept])


LEAST_POINTS = 50
"""Vertices of a kind below which there is nothing to fit to."""


def even_sample(points: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Indices of about ``count`` of points (N, 3), one from each occupied cell of a grid, in random order."""
    order = np.random.default_rng(seed).permutation(len(points))
    low = points.min(axis=0)
    small, large = 0.0, float(np.ptp(points, axis=0).max()) + 1e-9
    kept = order[:count]
    for _ in range(18):
        step = 0.5 * (small + large)
        cells = np.floor((points[order] - low) / step).astype(np.int64)
        _, first = np.unique(cells @ np.array([1, 1 << 20, 1 << 40]), return_index=True)
        kept = order[np.sort(first)]
        if abs(len(kept) - count) <= 0.02 * count:
            break
        small, large = (step, large) if len(kept) > count else (small, step)
    return kept


def _inward(cloud: Cloud) -> bool:
    """Whether most normals point towards the middle of what lies at their height."""
    height = cloud.points[:, 1]
    layer = np.clip(((height - height.min()) / (np.ptp(height) + 1e-9) * 24).astype(int), 0, 23)
    sizes = np.maximum(np.bincount(layer, minlength=24), 1)[:, None]
    centre = np.stack([np.bincount(layer, cloud.points[:, axis], 24) for axis in (0, 2)], axis=1) / sizes
    away = cloud.points[:, [0, 2]] - centre[layer]
    return bool(np.mean((away * cloud.normals[:, [0, 2]]).sum(axis=1) > 0) < 0.4)
