"""Scans seen in a mirror: where body and garments are the same on both sides, twice as many to learn from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from caphy.body.surface import nearest_on_surface
from caphy.io.poses import PoseSequence
from caphy.register.points import ScanPoints
from caphy.training.motions import mirrored

ALIKE = 0.012
"""How far [m] a body or garment may lie from its mirror image, 95 % of its vertices. No body is quite symmetric: two of
a virtual rig, as registered, are 5 and 9 mm off, and their garments 1 to 4 mm."""
MIRRORED = ", mirrored"
"""What is added to a scan's name."""
_FLIP = np.array([-1.0, 1.0, 1.0])


def symmetric(surfaces: Iterable[tuple[np.ndarray, np.ndarray]]) -> bool:
    """Whether surfaces, as vertices (V, 3) [m] and faces (F, 3) on the T-posed body, are their own mirror images."""
    return all(
        np.quantile(np.abs(nearest_on_surface(vertices * _FLIP, vertices, faces).distance), 0.95) <= ALIKE
        for vertices, faces in surfaces
    )


def with_mirror_images(points: Sequence[ScanPoints], pelvis: np.ndarray) -> list[ScanPoints]:
    """Scans, and after them their reflections in the plane x = 0 of the world, poses and all.

    pelvis: place (3,) [m] of that joint in the T-posed body, about which it turns.
    """
    return [*points, *(_reflected(scan, pelvis) for scan in points)]


def _reflected(scan: ScanPoints, pelvis: np.ndarray) -> ScanPoints:
    still = PoseSequence(scan.pose[None], scan.transl[None], 30.0, pelvis=pelvis)
    image, flip = mirrored(still), _FLIP.astype(np.float32)
    return replace(
        scan,
        name=f"{scan.name}{MIRRORED}",
        body=scan.body * flip,
        upper=scan.upper * flip,
        lower=scan.lower * flip,
        pose=image.poses[0],
        transl=image.transl[0],
    )
