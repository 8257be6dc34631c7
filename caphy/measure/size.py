"""Whether a registered cloth is as large as its rest mesh."""

from __future__ import annotations

import numpy as np

from caphy.io.measurements import Measurement
from caphy.io.measurements.checks import edges_at_rest
from caphy.measure.noise import measurement_noise, overstated, scatter

SMALLEST, LARGEST = 0.9, 1.2
"""Median edge over that at rest: cloth wrinkles rather than to be pressed together, and a knit that hangs stretches."""
_FRAMES = 20


def misfitting(measurement: Measurement) -> str | None:
    """Doubt in words where most edges are shorter or longer than in the rest mesh; none where they are not, or there is
    nothing to compare."""
    if (known := edges_at_rest(measurement)) is None:
        return None
    a, b, rest = known
    frames = measurement.seen_vertices[:: max(len(measurement) // _FRAMES, 1)]
    noise = scatter(measurement) if overstated(measurement) else measurement_noise(measurement)
    longer = 0.0 if noise is None else 6 * noise.sigma**2  # three coordinates at either end
    ratio = (((frames[:, a] - frames[:, b]) ** 2).sum(-1) - longer) / np.maximum(rest, 1e-12) ** 2
    seen = np.isfinite(ratio)
    if not seen.any():
        return None
    middle = float(np.sqrt(max(np.median(ratio[seen]), 0.0)))
    if SMALLEST <= middle <= LARGEST:
        return None
    return (
        f"{measurement.name} has edges {middle:.2f} times as long as in its rest mesh, in the median of all; if the "
        "rest mesh is of another size, give the right one: else that is taken for stretch of the cloth"
    )
