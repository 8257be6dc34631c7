"""One door for measurements: an ``.npz`` file, or a folder with one mesh or cloud per frame."""

from __future__ import annotations

from pathlib import Path

from caphy.errors import CaphyError
from caphy.io.measurements.archive import read_archive, write_archive
from caphy.io.measurements.checks import require_plausible
from caphy.io.measurements.folder import DESCRIPTION, read_folder, write_folder
from caphy.io.measurements.measurement import Measurement

_POSED = ("betas", "weights", "attached", "preroll_poses")
"""Keys that only mean something beside poses."""


def read_measurement(path: str | Path) -> Measurement:
    """The measurement in an npz file or a folder, y up, its units, axes, frame rate and order checked.

    Raises :class:`CaphyError` that says what to change.
    """
    path = Path(path)
    if not path.exists():
        raise CaphyError(f"{path}: there is no such measurement")
    if path.is_dir():
        measurement, stated = read_folder(path)
    elif path.name == DESCRIPTION:
        measurement, stated = read_folder(path.parent)
    elif path.suffix == ".npz":
        measurement, stated = read_archive(path)
    else:
        raise CaphyError(
            f"{path}: a measurement is an .npz file or a folder with a {DESCRIPTION}, a table of tensile tests a .csv"
        )
    require_plausible(measurement, axes_stated=stated)
    return _told_of_what_nobody_reads(measurement)


def _told_of_what_nobody_reads(measurement: Measurement) -> Measurement:
    """The same with a note where it says how cloth is worn on a posed body, and has no poses."""
    given = [name for name in _POSED if getattr(measurement, name) is not None]
    if measurement.poses is not None or not given:
        return measurement
    return measurement.with_notes(
        f"{', '.join(given)} tell of a body in poses; there are no poses, so they are ignored"
    )


def write_measurement(measurement: Measurement, path: str | Path) -> Path:
    """Write an npz (a name that ends in ``.npz``) or else a folder with one PLY per frame; whole or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npz":
        write_archive(measurement, path)
    else:
        write_folder(measurement, path)
    return path
