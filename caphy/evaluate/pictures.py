"""Scan and predictions side by side, with where and how much they differ."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from caphy.evaluate.dressed import Dressed
from caphy.evaluate.perceptual import Perceptual
from caphy.evaluate.score import HeldOut
from caphy.evaluate.views import SIZE, cameras, coloured_view, dressed_view
from caphy.report.page.colours import error_colours
from caphy.report.render import contact_sheet

LARGEST = 30.0
"""Distance that gets the last colour [mm]."""
SIDES = (0, 2)
"""Which of the four views are pictured."""


def side_by_side(held: HeldOut, rows: Mapping[str, Dressed], look: Perceptual | None) -> np.ndarray:
    """An image: the scan, then for each row the prediction, its distance from the scan, and the perceptual error map.

    Each from before and from behind. The perceptual map is white where pictures agree; its last colour is one.
    """
    images, labels = _first_line(held, look)
    for name, dressed in rows.items():
        distances = held.distances(dressed)
        colours = [error_colours(1e3 * values, LARGEST) for values in distances]
        mean = 1e3 * np.concatenate(distances).mean()
        looks = None if look is None else held.looks(dressed, look)
        views = cameras(held.scan)
        for side in SIDES:
            picture = looks[side][0] if looks else dressed_view(dressed, views[side])
            images += [picture, coloured_view(dressed, colours, views[side])]
            labels += [name, f"{mean:.1f} mm off, all vertices"]
            if looks is not None and look is not None:
                images.append(error_picture(looks[side][2]))
                labels.append(f"{look.name} {looks[side][1]:.3f}")
    return contact_sheet(images, len(SIDES) * (2 if look is None else 3), labels)


def _first_line(held: HeldOut, look: Perceptual | None) -> tuple[list[np.ndarray], list[str]]:
    images, labels = [], []
    blank = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    for side in SIDES:
        images += [held.pictures[side], scale_picture()] + ([] if look is None else [blank])
        labels += [held.scan.name, f"0 to {LARGEST:g} mm"] + ([] if look is None else [""])
    return images, labels


def scale_picture() -> np.ndarray:
    """The scale of distances as an image of a view's size."""
    image = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    ramp = np.rint(255 * error_colours(np.linspace(1, 0, SIZE[1] // 2), 1.0))
    top, middle = SIZE[1] // 4, SIZE[0] // 2
    image[top : top + len(ramp), middle - 12 : middle + 12] = ramp[:, None]
    return image


def error_picture(error: np.ndarray) -> np.ndarray:
    """An error map (H, W) as an image: white for nothing, the scale's last colour from one on."""
    colours = error_colours(error.ravel(), 1.0).reshape(*error.shape, 3)
    fade = np.minimum(4 * error, 1)[..., None]
    return np.rint(255 * (1 - fade * (1 - colours))).astype(np.uint8)
