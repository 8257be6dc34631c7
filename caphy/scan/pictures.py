"""Scans to look at: in their colours from three sides, and by label."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.report.camera import Camera
from caphy.report.render import CLOTH, SKIN, Shape, render
from caphy.scan.scan import UNKNOWN, Scan

LABEL_COLOURS: Final = (SKIN, CLOTH[1], CLOTH[2])
"""Of body, upper and lower garment."""
NOBODY: Final = (0.9, 0.2, 0.9)
"""Of vertices nobody knows anything of."""


def scan_pictures(scan: Scan, size: tuple[int, int] = (300, 400)) -> list[np.ndarray]:
    """Four images (height, width, 3): front, side and back in colour, and the labels (grey without any)."""
    colours = 0.7 if scan.colours is None else scan.colours / 255
    shape = Shape(scan.vertices, scan.faces, np.full(3, colours) if np.isscalar(colours) else colours)
    images = [render([shape], _camera(scan, azimuth, size), size) for azimuth in (10.0, 100.0, 190.0)]
    labelled = Shape(scan.vertices, scan.faces, label_colours(scan))
    return [*images, render([labelled], _camera(scan, 10.0, size), size)]


def label_colours(scan: Scan) -> np.ndarray:
    """Colours (V, 3) of a scan's labels."""
    if scan.labels is None:
        return np.full((len(scan.vertices), 3), 0.7)
    table = np.tile(np.array(NOBODY), (UNKNOWN + 1, 1))
    table[: len(LABEL_COLOURS)] = LABEL_COLOURS
    return table[scan.labels]


def _camera(scan: Scan, azimuth: float, size: tuple[int, int]) -> Camera:
    return Camera.framing(scan.vertices, azimuth, aspect=size[0] / size[1])
