"""How many frames a second of a recording are used."""

from __future__ import annotations

from caphy.io.measurements import Measurement

FASTEST = 45.0
"""Frames per second up to which all are used."""
PACE = 30.0
"""About how many are used of faster recordings [Hz].

A window of 8 frames must last long enough for a force to move the cloth by more than its start is wrong by."""


def paced(measurement: Measurement) -> Measurement:
    """A measurement at a rate at which windows last long enough, with a note where that is not its own."""
    note = slowed(measurement)
    if note is None:
        return measurement
    step = _step(measurement)
    if not (measurement.seen_frames % step == 0).any():
        raise measurement.error(
            f"of its frames one in {step} is used, from frame 0 on, and none of these shows anything; leave out the "
            "frames that nobody sees, and give fps as the rate of those that are left"
        )
    return measurement.every(step).with_notes(note)


def slowed(measurement: Measurement) -> str | None:
    """Why not all frames of a measurement are used, or none if they are."""
    step = _step(measurement)
    if step == 1:
        return None
    return (
        f"{measurement.name} has {measurement.fps:g} frames a second, of which one of {step} is used: windows would "
        "be too short to tell a force from noise"
    )


def _step(measurement: Measurement) -> int:
    return round(measurement.fps / PACE) if measurement.fps > FASTEST else 1
