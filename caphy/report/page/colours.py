"""Colour scales of errors, the same in pictures, plots and the viewer."""

from __future__ import annotations

from typing import Final

import numpy as np

SEQUENTIAL: Final = ("#dfe7ee", "#f6cf45", "#ee7b35", "#c3263f", "#4c1350")
"""From no error to the largest; lightness falls all the way, so that it reads without hues too."""
DIVERGING: Final = ("#1f5fa8", "#8fb8dd", "#eeeeee", "#eda48d", "#b3202c")
"""From negative to positive."""
UNKNOWN: Final = "#9a9a9a"
"""Where nothing was measured."""


def rgb(colour: str) -> np.ndarray:
    """(3,) in 0 to 1 of "#rrggbb"."""
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255


def error_colours(values: np.ndarray, largest: float) -> np.ndarray:
    """sRGB colours (V, 3) in 0 to 1 of errors (V,), grey where they are NaN; ``largest`` gets the last colour."""
    stops = np.stack([rgb(colour) for colour in SEQUENTIAL])
    share = np.clip(np.nan_to_num(values) / max(largest, 1e-12), 0, 1)
    place = np.linspace(0, 1, len(stops))
    colours = np.stack([np.interp(share, place, stops[:, k]) for k in range(3)], axis=-1)
    colours[~np.isfinite(values)] = rgb(UNKNOWN)
    return colours


def nice_ceiling(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 5, 10, 15, 20, ... (and tenths of them) that is not smaller."""
    if not np.isfinite(value) or value <= 0:
        return 1.0
    power = int(np.floor(np.log10(value)))
    steps = (float(f"{step}e{power}") for step in (1, 1.5, 2, 3, 5, 10))  # written, so that 0.15 has no further digits
    return next(step for step in steps if step >= value * (1 - 1e-9))
