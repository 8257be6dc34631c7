"""Panel coordinates (UV) as rest metric, when they are flat cloth in metres and not texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.garment import topology

AGREEING = 0.5
"""Share of edges whose panel and 3-D lengths must agree within 10 %; not all, since sewing stretches some."""
SEAM = 0.05
"""Relative difference of an edge's length in its two panels above which it counts as inconsistent."""


@dataclass(frozen=True)
class PanelReport:
    """What panel coordinates turned out to be."""

    ratio: float
    """Median of panel edge length over 3-D edge length."""
    agreeing: float
    """Share of edges whose panel and 3-D lengths agree within 10 %."""
    seam_mismatch: float
    """Share of interior edges whose two panels disagree on the length by more than :data:`SEAM`."""
    flipped: int
    """Faces drawn mirrored in their panel."""
    flat: int
    """Faces without area in the panel."""

    @property
    def usable(self) -> bool:
        """Whether the coordinates are a rest metric in metres."""
        return not self.complaint()

    def complaint(self, scale: float = 1.0) -> str:
        """Why the coordinates, which were given times ``scale``, are no rest metric, or an empty string."""
        if self.flat:
            return f"{self.flat} faces have no area in the panel coordinates"
        if self.agreeing < AGREEING:
            return (
                f"panel edges are {self.ratio:.3g} times the 3-D edges and only {100 * self.agreeing:.0f} % agree "
                "within 10 %: texture coordinates, not flat cloth in metres (if they are flat cloth in another "
                f"unit, pass --panel-scale {scale / max(self.ratio, 1e-9):.3g})"
            )
        if self.seam_mismatch > 0.1:
            return f"{100 * self.seam_mismatch:.0f} % of interior edges differ in length between their two panels"
        return ""


def examine(vertices: np.ndarray, faces: np.ndarray, panel: np.ndarray) -> PanelReport:
    """Compare panel coordinates (F, 3, 2) [m] with the mesh's 3-D edges."""
    solid = edge_lengths(vertices[faces])
    flat = edge_lengths(panel)
    ratio = (flat / np.maximum(solid, 1e-12)).ravel()
    area = signed_areas(panel)
    typical = np.median(np.abs(area))
    one, two = _both_sides(faces, flat)
    mismatch = np.abs(one - two) > SEAM * np.maximum(one, two)
    return PanelReport(
        ratio=float(np.median(ratio)),
        agreeing=float((np.abs(ratio - 1.0) < 0.1).mean()),
        seam_mismatch=float(mismatch.mean()),
        flipped=int((area < 0).sum()),
        flat=int((np.abs(area) <= 1e-6 * typical).sum()),
    )


def material_from_panels(panel: np.ndarray) -> np.ndarray:
    """Rest shapes (F, 3, 2) [m] from panels (F, 3, 2): u = weft, v = warp as drawn, area made positive.

    A panel drawn mirrored (the left half of a symmetric pair) is turned over: u changes sign, lengths stay. Where
    two panels disagree on a seam by a few percent each face keeps its own length, as sewn cloth does.
    """
    material = panel - panel[:, :1]
    material[signed_areas(panel) < 0, :, 0] *= -1.0
    return material


def edge_lengths(corners: np.ndarray) -> np.ndarray:
    """Lengths (F, 3) of the edges k -> k + 1 of triangles (F, 3, D)."""
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)


def signed_areas(corners: np.ndarray) -> np.ndarray:
    """Signed areas (F,) of flat triangles (F, 3, 2), positive counter-clockwise."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _both_sides(faces: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Panel lengths (H,), (H,) of each interior edge in its first and second face."""
    ends = topology.hinges(faces)[:, :2]
    pair = topology.hinge_faces(faces)
    found = []
    for face, start in ((pair[:, 0], ends[:, 0]), (pair[:, 1], ends[:, 1])):
        corner = (faces[face] == start[:, None]).argmax(axis=1)
        found.append(lengths[face, corner])
    return found[0], found[1]
