"""Pictures of a fit: each scan in its labels' colours, and the body that was found within."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caphy.report.camera import Camera
from caphy.report.render import CLOTH, SKIN, Shape, contact_sheet, render
from caphy.scan.scan import BODY, LOWER, UPPER, Scan

BODY_COLOUR = (0.36, 0.62, 0.52)
SIZE = (300, 400)


def fit_sheet(scans: Sequence[Scan], bodies: Sequence[np.ndarray], faces: np.ndarray) -> np.ndarray:
    """For each scan: the scan, the body (V, 3) with the scan's skin, and the body alone; two scans a row."""
    images, labels = [], []
    for scan, body in zip(scans, bodies, strict=True):
        camera = Camera.framing(scan.vertices, azimuth=25.0, aspect=SIZE[0] / SIZE[1])
        found = Shape(body, faces, BODY_COLOUR)
        skin = Shape(scan.vertices, scan.faces[(_labels(scan)[scan.faces] == BODY).all(axis=1)], SKIN)
        for shapes, label in (
            ([Shape(scan.vertices, scan.faces, _colours(scan))], scan.name),
            ([found, skin], "body and bare skin"),
            ([found], "body"),
        ):
            images.append(render(shapes, camera, SIZE))
            labels.append(label)
    return contact_sheet(images, 6 if len(scans) > 1 else 3, labels)


def _labels(scan: Scan) -> np.ndarray:
    return np.full(len(scan.vertices), BODY) if scan.labels is None else scan.labels


def _colours(scan: Scan) -> np.ndarray:
    table = np.full((256, 3), 0.5)
    table[BODY], table[UPPER], table[LOWER] = SKIN, CLOTH[1], CLOTH[2]
    return table[_labels(scan)]
