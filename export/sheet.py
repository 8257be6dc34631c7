"""A contact sheet of a dressed motion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from caphy.io.bundle import AvatarBundle
from caphy.report.camera import Camera
from caphy.report.render import CLOTH, Shape, contact_sheet, render


def motion_sheet(
    bundle: AvatarBundle,
    poses: np.ndarray,
    transl: np.ndarray,
    vertices: Mapping[str, np.ndarray],
    *,
    frames: int = 6,
    azimuths: tuple[float, ...] = (25.0, 205.0),
    size: tuple[int, int] = (280, 400),
) -> np.ndarray:
    """An image (height, width, 3) uint8: a row per direction of view [degrees], a column per moment.

    ``poses`` (T, 55, 3) [rad], ``transl`` (T, 3) [m] and the garments' ``vertices`` (T, V, 3) [m] at the bundle's
    frame rate. Raises CaphyError where embreex is not installed.
    """
    chosen = np.unique(np.linspace(0, len(poses) - 1, frames).round().astype(int))
    body = bundle.body.posed(bundle.transforms(poses[chosen], transl[chosen]))
    scenes = []
    for i, frame in enumerate(chosen):
        cloth = [
            Shape(vertices[garment.name][frame], garment.mesh.faces, colour)
            for garment, colour in zip(bundle.garments, CLOTH * len(bundle.garments), strict=False)
            if garment.name in vertices
        ]
        scenes.append([Shape(body[i], bundle.body.faces), *cloth])
    aspect, floor = size[0] / size[1], float(body[..., 1].min())
    images = [
        render(scene, Camera.framing(body[i], azimuth, aspect=aspect), size, ground=floor, shadows=True)
        for azimuth in azimuths
        for i, scene in enumerate(scenes)
    ]
    labels = [f"{frame / bundle.fps:.2f} s" for frame in chosen] * len(azimuths)
    return contact_sheet(images, len(chosen), labels)
