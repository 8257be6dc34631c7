"""What is said of recordings before anything is made of them."""

from __future__ import annotations

from collections.abc import Iterable

from caphy.io.measurements import Measurement
from caphy.measure.noise import overstated, understated
from caphy.measure.pace import slowed
from caphy.measure.size import misfitting
from caphy.measure.strays import torn


def remarks(measurements: Iterable[Measurement], every_frame: bool = False) -> list[str]:
    """In words, once for all of which it is true: of which frames some are left out (none are where ``every_frame`` is
    used, as of avatars), whose stated noise the data do not show, whose rest mesh is of another size, and whose
    vertices lie far from their neighbours."""
    said: dict[str, list[str]] = {}
    given = list(measurements)
    for say in (*(() if every_frame else (slowed,)), overstated, understated, misfitting, torn):
        for each in given:
            if (note := say(each)) is not None:
                said.setdefault(note.removeprefix(f"{each.name} "), []).append(each.name)
    return [
        f"{names[0]} {what}" if len(names) == 1 else f"{', '.join(names)}: each {what}" for what, names in said.items()
    ]
