"""Whether pinned vertices were measured where the pins are: all of them, in all frames, at the same times."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.io.measurements.measurement import Measurement

BESIDE: Final = 0.02
"""Distance [m] from its pin within which a vertex is in half of the frames: clamps and threads are so thick ..."""
ASTRAY: Final = 2.5
"""... and times that within which half of the vertices are in each frame."""
NOISES: Final = 5.0
"""Standard deviations of the noise that are let pass besides."""
LATE: Final = 6
"""Frames by which pins are tried to be late or early ..."""
FITS: Final = 0.25
"""... share of their distance to which it must fall for that to be said ..."""
PARTED: Final = 0.003
"""... and that distance [m], at least."""
_NOISE: Final = 2e-3  # [m] where none is stated


def require_pins(measurement: Measurement) -> None:
    """Raise :class:`CaphyError`, saying what to change, unless held vertices that were seen lie where the pins are."""
    if measurement.pinned is None or measurement.pinned_positions is None or measurement.vertices is None:
        return
    held, pins = measurement.seen_vertices[:, measurement.pinned], measurement.pinned_positions
    away = np.linalg.norm(held - pins, axis=-1)
    if not np.isfinite(away).any():
        return
    limit, middle = BESIDE + NOISES * _noise(measurement), float(np.nanmedian(away))
    _require_same_times(measurement, held, pins, limit)
    seen = np.flatnonzero(np.isfinite(away).any(axis=0))
    each = np.nanmedian(away[:, seen], axis=0)
    if each.min() > limit:
        raise measurement.error(
            f"the pinned vertices were measured {1000 * middle:.0f} mm from pinned_positions; check the order of "
            "'pinned', the unit, the axes, and that both were recorded at the same times"
        )
    if each.max() > limit:
        pin = int(seen[np.argmax(each)])
        raise measurement.error(
            f"vertex {measurement.pinned[pin]}, number {pin} of 'pinned', was measured {1000 * each.max():.0f} mm from "
            "its pinned_positions in half of the frames; check its number and its place, or leave it out of both"
        )
    frames = np.flatnonzero(np.isfinite(away).any(axis=1))
    astray = 1e3 * np.nanmedian(away[frames], axis=1)
    if astray.max() > 1e3 * ASTRAY * limit:
        raise measurement.error(
            f"in frame {measurement.number(frames[np.argmax(astray)])} the pinned vertices were measured "
            f"{astray.max():.0f} mm from pinned_positions, in half of the frames {1000 * middle:.0f} mm; put that "
            "frame right, or leave its vertices empty (NaN) if it is they that are wrong"
        )


def _require_same_times(measurement: Measurement, held: np.ndarray, pins: np.ndarray, limit: float) -> None:
    apart = {0: _apart(held, pins)}
    for lag in range(1, min(LATE, len(pins) // 4) + 1):
        apart |= {lag: _apart(held[:-lag], pins[lag:]), -lag: _apart(held[lag:], pins[:-lag])}
    best = min(apart, key=lambda lag: apart[lag])
    if not best or apart[0] < PARTED or apart[best] > min(FITS * apart[0], limit):
        return
    many = f"{abs(best)} frame{'s' if abs(best) > 1 else ''}"
    raise measurement.error(
        f"the pins are {'late' if best > 0 else 'early'} by {many}: the pinned vertices were measured "
        f"{1000 * apart[0]:.0f} mm from pinned_positions of the same frames and {1000 * apart[best]:.0f} mm from those "
        f"{abs(best)} {'later' if best > 0 else 'earlier'}; give both at the same times"
    )


def _apart(held: np.ndarray, pins: np.ndarray) -> float:
    away = np.linalg.norm(held - pins, axis=-1)
    return float(np.nanmedian(away)) if np.isfinite(away).any() else np.inf


def _noise(measurement: Measurement) -> float:
    """Standard deviation that is stated [m], or a usual one."""
    if measurement.noise_mm is not None:
        return 1e-3 * measurement.noise_mm
    return _NOISE if measurement.noise is None else float(np.nanmedian(measurement.noise))
