"""Pictures of a scan from all round by ray casting: colour, depth, and which vertices each of them shows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from caphy.report.camera import Camera
from caphy.report.render import embree_scene
from caphy.scan.scan import Scan

RINGS: Final = ((-20.0, 10), (8.0, 12), (38.0, 10))
"""Elevation [degrees] of each ring of views and how many it has: 32 in all, as in CaPhy."""
SIZE: Final = (256, 384)
"""Width and height of a picture [pixels]."""
BEHIND: Final = 0.012
"""A vertex this much farther away than what its pixel shows is hidden [m]."""
BACKDROP: Final = 255


@dataclass(frozen=True, eq=False)
class ScanView:
    """One picture of a scan. Images have H rows and W columns; ``hit`` (H, W) tells where the scan is."""

    scan: Scan
    camera: Camera
    face: np.ndarray
    """Face seen by each pixel (H, W), or -1."""
    weights: np.ndarray
    """Weights (N, 3) of that face's corners, for the pixels that hit, row by row."""
    depth: np.ndarray
    """Distance along the view (H, W) [m]; infinite where nothing is."""

    @property
    def hit(self) -> np.ndarray:
        """Where the scan is, (H, W)."""
        return self.face >= 0

    @cached_property
    def colour(self) -> np.ndarray:
        """RGB (H, W, 3) uint8 before a plain backdrop; grey where the scan has no colours."""
        height, width = self.face.shape
        image = np.full((height, width, 3), BACKDROP, dtype=np.uint8)
        colours = self.scan.colours
        if colours is None:
            image[self.hit] = 128
        else:
            corners = self.scan.faces[self.face[self.hit]]
            image[self.hit] = np.rint(np.einsum("nk,nkc->nc", self.weights, colours[corners].astype(np.float32)))
        return image

    @cached_property
    def nearest_vertex(self) -> np.ndarray:
        """For each pixel that hit, the corner (N,) it lies nearest to."""
        corners = self.scan.faces[self.face[self.hit]]
        return np.take_along_axis(corners, self.weights.argmax(axis=1)[:, None], axis=1)[:, 0]

    def visible(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (N,) that the picture shows, and row and column (N,) of the pixel of each."""
        right, up, forward = self.camera.axes()
        offset = self.scan.vertices - self.camera.eye
        height, width = self.face.shape
        ahead = offset @ forward
        pixel = 2 * np.tan(np.radians(self.camera.field_of_view) / 2) / min(width, height) * ahead
        column = np.rint(offset @ right / pixel + (width - 1) / 2).astype(int)
        row = np.rint((height - 1) / 2 - offset @ up / pixel).astype(int)
        inside = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
        row, column = row[inside], column[inside]
        shown = ahead[inside] < self.depth[row, column] + BEHIND
        shown &= np.isfinite(self.depth[row, column])
        return inside[shown], row[shown], column[shown]


def scan_views(scan: Scan, size: tuple[int, int] = SIZE) -> Iterator[ScanView]:
    """The views of :data:`RINGS`, one after another."""
    caster = embree_scene(scan.vertices, scan.faces)
    width, height = size
    for ring, (elevation, count) in enumerate(RINGS):
        for number in range(count):
            camera = Camera.framing(scan.vertices, 360 / count * (number + ring / 3), elevation, aspect=width / height)
            rays = camera.rays(width, height).astype(np.float32)
            origin = np.broadcast_to(np.asarray(camera.eye, np.float32), rays.shape)
            found = caster.run(np.ascontiguousarray(origin), rays, output=True)
            face = found["primID"].astype(np.int64)
            hit = face >= 0
            u, v = found["u"][hit], found["v"][hit]
            along = np.where(hit, found["tfar"] * (rays @ camera.axes()[2].astype(np.float32)), np.inf)
            shape = (height, width)
            yield ScanView(scan, camera, face.reshape(shape), np.stack([1 - u - v, u, v], 1), along.reshape(shape))
