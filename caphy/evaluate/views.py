"""Scans and predictions pictured alike, so that pictures of them can be compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from caphy.evaluate.dressed import Dressed
from caphy.report.camera import Camera
from caphy.report.render import BACKGROUND, CLOTH, SKIN, Shape, render
from caphy.scan.pictures import label_colours
from caphy.scan.scan import Scan

SIZE: Final = (240, 360)
"""Width and height of a picture [pixels]."""
AZIMUTHS: Final = (20.0, 110.0, 200.0, 290.0)
"""Directions that pictures are taken from [degrees]: before, left, behind, right, each a little turned."""
COLOURS: Final = {"upper": CLOTH[1], "lower": CLOTH[2]}


def cameras(scan: Scan) -> list[Camera]:
    """Four cameras round a scan."""
    aspect = SIZE[0] / SIZE[1]
    return [Camera.framing(scan.vertices, azimuth, aspect=aspect, margin=1.1) for azimuth in AZIMUTHS]


def scan_view(scan: Scan, camera: Camera) -> np.ndarray:
    """A scan in the colours of its labels: geometry is compared, not paint."""
    return render([Shape(scan.vertices, scan.faces, label_colours(scan))], camera, SIZE)


def dressed_view(dressed: Dressed, camera: Camera) -> np.ndarray:
    """A prediction in the same colours."""
    garments = [Shape(*mesh, COLOURS[kind]) for kind, mesh in dressed.garments.items()]
    return render([Shape(dressed.body, dressed.body_faces, SKIN), *garments], camera, SIZE)


def coloured_view(dressed: Dressed, colours: Sequence[np.ndarray], camera: Camera) -> np.ndarray:
    """A prediction whose garments have colours (V, 3) of their own."""
    meshes = zip(dressed.garments.values(), colours, strict=True)
    garments = [Shape(*mesh, colour) for mesh, colour in meshes]
    return render([Shape(dressed.body, dressed.body_faces, (0.8, 0.8, 0.8)), *garments], camera, SIZE)


def somebody(*images: np.ndarray) -> np.ndarray:
    """Pixels (H, W) where any of the images shows more than the background."""
    backdrop = np.rint(255 * np.array(BACKGROUND)).astype(np.uint8)
    return np.any([(image != backdrop).any(axis=-1) for image in images], axis=0)
