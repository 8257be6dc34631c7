"""What is said of recordings before anything is made of them."""

from __future__ import annotations

from collections.abc import Iterable

from caphy.io.measurements import Measurement
from caphy.measure.noise import overstated
from caphy.measure.pace import slowed


def remarks(measurements: Iterable[Measurement]) -> list[str]:
    """In words: of which frames some are left out, and whose stated noise the data do not show."""
    given = list(measurements)
    return [note for say in (slowed, overstated) for each in given if (note := say(each)) is not None]
