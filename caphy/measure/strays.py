"""Whether single vertices of a registered cloth lie where none can be: lost by a tracker, or taken for another."""

from __future__ import annotations

import numpy as np

from caphy.io.measurements import Measurement
from caphy.io.measurements.checks import edges_at_rest
from caphy.measure.noise import measurement_noise

LONGEST = 2.5
"""Length of an edge over that at rest that no cloth has."""
SURE = 6.0
"""Standard deviations of the noise of an edge's length by which it must be longer than that."""


def torn(measurement: Measurement) -> str | None:
    """Doubt in words where edges are longer than those of any cloth; none where there are none, or no rest mesh."""
    if (known := edges_at_rest(measurement)) is None:
        return None
    a, b, rest = known
    noise = measurement_noise(measurement)
    longest = LONGEST * rest + SURE * np.sqrt(2) * (0.0 if noise is None else noise.sigma)
    worst, frames, found = 0.0, 0, (0, 0)
    for frame in measurement.seen_frames:
        x = measurement.seen_vertices[frame]
        length = np.linalg.norm(x[a] - x[b], axis=1)
        long = length > longest
        if not long.any():
            continue
        frames += 1
        ratio = float((length[long] / np.maximum(rest[long], 1e-12)).max())
        if ratio > worst:
            ends = np.bincount(np.concatenate([a[long], b[long]]))
            worst, found = ratio, (int(frame), int(ends.argmax()))
    if not frames:
        return None
    return (
        f"{measurement.name} has edges up to {worst:.3g} times as long as at rest, in {frames} of "
        f"{len(measurement.seen_frames)} frames, such as those of vertex {found[1]} in frame "
        f"{measurement.number(found[0])}; if it was lost or taken for another, leave it empty there (NaN): else that "
        "is taken for the cloth's own motion"
    )
