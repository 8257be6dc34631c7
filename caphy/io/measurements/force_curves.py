"""Uniaxial tensile tests: force per width against axial and transverse strain."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from caphy.errors import CaphyError

COLUMNS: Final = ("axial_strain", "transverse_strain", "force_per_width_N_per_m")
NAMES: Final = ("fabric", "direction", "loading")
KNIT_COLUMNS: Final = ("sample", "video", "force_per_width_N_per_m", "gauge_len_mm", "pin_transverse_mm")
_RATIO: Final = 0.5  # smallest strain of a curve from which on lengths over rest lengths were given
_LONGEST: Final = 3.0  # strain; real knits of a test reach 2.04
_NARROWS: Final = 5.0
"""Times its axial strain by which no strip narrows; real knits of a test do by up to 0.53."""
_ACROSS: Final = ("transverse_strain", "pin_transverse_mm")
"""Columns that may be NaN."""
_AGAIN: Final = 0.5
"""Share of its largest strain by which a curve that falls and rises again is more than one."""
UNLOADED: Final = 1.0
"""Force per width below which a sample counts as unloaded [N/m]; load cells of such tests resolve about 0.1."""

_Row = tuple[int, Mapping[str, str]]
"""A line's number, and its values by column."""


@dataclass(frozen=True, eq=False)
class ForceCurve:
    """One loading of one strip of cloth.

    Raises :class:`CaphyError` where columns differ in length, are not finite, look like percent or millimetres, or
    would leave nothing of the strip's length or width.
    """

    fabric: str
    direction: str
    """"weft" or "warp" (for knits: course, wale): the way it was pulled."""
    loading: int
    """1 for the first loading of the strip, then 2, 3, ..."""
    axial: np.ndarray
    """Engineering strain along the pull, length / rest length - 1, (N,)."""
    transverse: np.ndarray
    """Engineering strain across, (N,); NaN where it was not measured."""
    force: np.ndarray
    """Force per rest width (N,) [N/m]."""
    source: str = ""

    def __post_init__(self) -> None:
        where = f"{self.source or 'force curve'}: {self.fabric} {self.direction}, loading {self.loading}"
        columns = {"axial": self.axial, "transverse": self.transverse, "force": self.force}
        count = len(self.axial)
        for name, column in columns.items():
            if column.shape != (count,) or count < 3:
                raise CaphyError(
                    f"{where}: {name} must have as many values as the others, at least 3, got {column.shape}"
                )
            if name != "transverse" and not np.isfinite(column).all():
                raise CaphyError(f"{where}: {name} must be finite, got NaN or infinity at row {_first_bad(column)}")
        if not self.force.any():
            raise CaphyError(f"{where}: its force is zero throughout; give the force per width [N/m] of each row")
        if self.axial.min() > _RATIO:
            raise CaphyError(
                f"{where}: axial strains must start near 0, got {self.axial.min():.3g} at least; a strain is a length "
                "over the rest length, less one"
            )
        if self.direction not in ("weft", "warp"):
            raise CaphyError(f"{where}: direction must be 'weft' or 'warp', got {self.direction!r}")
        for name in ("axial", "transverse"):
            most = float(np.nanmax(np.abs(columns[name]), initial=0))
            if most > _LONGEST:
                raise CaphyError(
                    f"{where}: {name} strains must be fractions (0.1 for 10 %), got {most:.3g}; divide percent by 100; "
                    "a strain is a length over the rest length, less one"
                )
            least = float(np.nanmin(columns[name], initial=0))
            if least <= -1:
                raise CaphyError(
                    f"{where}: {name} strains must be above -1, where no length is left, got {least:.3g}; divide "
                    "percent by 100; a strain is a length over the rest length, less one"
                )
        pulled = (self.axial > 0.5 * self.axial.max()) & np.isfinite(self.transverse)
        across = np.abs(self.transverse[pulled]) / self.axial[pulled]
        if len(across) and np.median(across) > _NARROWS:
            raise CaphyError(
                f"{where}: transverse strains must be at most {_NARROWS:g} times as large as axial ones, got "
                f"{np.median(across):.3g} times in the median of rows above half of the largest strain; percent beside "
                "fractions? Give both as fractions (0.1 for 10 %)"
            )

    @property
    def name(self) -> str:
        """Fabric, direction and loading."""
        return f"{self.fabric} {self.direction} {self.loading}"


def read_force_curves(path: str | Path) -> list[ForceCurve]:
    """All curves of a CSV.

    Columns: fabric, direction (weft, warp), loading, axial_strain, transverse_strain, force_per_width_N_per_m; the
    first three may be left out. Also read: the table of knit tests by Singal et al. (sample, video, gauge_len_mm, ...),
    whose course direction (X) is the weft here, and whose strains are measured from the lengths at no load.

    Raises :class:`CaphyError` naming file, line and column.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # as Excel writes it
            reader = csv.DictReader(file)
            try:
                table = [(reader.line_num, row) for row in reader]
            except csv.Error as error:
                raise CaphyError(
                    f"{path}: line {reader.line_num + 1}: {error}; is a quotation mark left open there?"
                ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise CaphyError(f"{path}: cannot be read: {error}") from error
    rows = [(line, row) for line, row in table if any(row.values())]  # spreadsheets end in rows of commas
    if not rows:
        raise CaphyError(f"{path}: a table of force curves needs a header and rows, got none")
    names = list(rows[0][1])
    if set(KNIT_COLUMNS) <= set(names):
        return _knit_curves(rows, path)
    header = [name for name in reader.fieldnames or () if name is not None]
    if twice := next((name for name in header if header.count(name) > 1), None):
        raise CaphyError(f"{path}: the column {twice!r} is there twice; leave one of them out")
    missing = [name for name in COLUMNS if name not in names and name != "transverse_strain"]
    if missing:
        got = ", ".join(name for name in names if name is not None)
        raise CaphyError(
            f"{path}: needs the columns {', '.join(COLUMNS)}; {missing[0]} is missing, got {got}; the first line names "
            "them; commas part columns, points decimals"
        )
    if unread := [name for name in names if name is not None and name not in (*NAMES, *COLUMNS)]:
        raise CaphyError(
            f"{path}: nobody reads the column {unread[0]!r}; the columns are {', '.join((*NAMES, *COLUMNS))}, so "
            "spelled: rename it, or leave it out"
        )
    surplus = next((line for line, row in rows if any(row.get(None) or ())), None)  # pyright: ignore
    if surplus is not None:
        raise CaphyError(
            f"{path}: line {surplus} has more cells than the first line names; commas part columns, points decimals"
        )
    curves = []
    for (fabric, direction, loading), part in _groups(rows, NAMES).items():
        columns = [_column(part, name, path) if name in names else np.full(len(part), np.nan) for name in COLUMNS]
        axial, transverse, force = columns
        number = _loading(loading, "loading", path, part[0][0])
        _require_one_loading(axial, f"{path}: {fabric or path.stem} {direction or 'weft'}, loading {number}")
        curves.append(ForceCurve(fabric or path.stem, direction or "weft", number, axial, transverse, force, str(path)))
    return curves


def _loading(text: str, what: str, path: Path, line: int) -> int:
    """The number of a loading, 1 where none is given; tables may write it with decimals."""
    try:
        number = float(text or 1)
    except ValueError:
        number = 0.0
    if not (number >= 1 and number.is_integer()):
        raise CaphyError(
            f"{path}: line {line}: {what} must be 1 for the first loading of a strip, then 2, 3, ..., got {text!r}"
        )
    return int(number)


def _require_one_loading(axial: np.ndarray, where: str) -> None:
    """A strip is pulled once, and may be let go: rows that begin anew are of another loading, or another strip."""
    most = float(axial.max(initial=0.0))
    falls = np.maximum.accumulate(axial) - axial
    peak = int(axial.argmax()) if len(axial) else 0
    rises = axial[peak:] - np.minimum.accumulate(axial[peak:])
    again = max(float(falls[:peak].max(initial=0.0)), float(rises.max(initial=0.0)))
    if np.isfinite(axial).all() and again > _AGAIN * most:
        raise CaphyError(
            f"{where}: its strain falls and rises again by {again:.3g}, so that it holds more than one loading; number "
            "them 1, 2, 3, ... in the column loading, and give strips other names in the column fabric"
        )


def _knit_curves(rows: Sequence[_Row], path: Path) -> list[ForceCurve]:
    curves = []
    for (sample, video), part in _groups(rows, ("sample", "video")).items():
        fabric, _, axis = sample.rpartition("_")
        force = _column(part, "force_per_width_N_per_m", path)
        curves.append(
            ForceCurve(
                fabric,
                {"X": "weft", "Y": "warp"}.get(axis, axis),
                _loading("".join(filter(str.isdigit, video)), "the number in video", path, part[0][0]),
                _strain(_lengths(part, "gauge_len_mm", path), force),
                _strain(_lengths(part, "pin_transverse_mm", path), force),
                force,
                str(path),
            )
        )
    return curves


def _lengths(part: Sequence[_Row], name: str, path: Path) -> np.ndarray:
    """A column of lengths (N,) [mm]; raises :class:`CaphyError` where one is not above 0."""
    lengths = _column(part, name, path)
    for (line, row), length in zip(part, lengths, strict=True):
        if length <= 0:
            raise CaphyError(f"{path}: line {line}: {name} must be a length above 0 [mm], got {row[name]!r}")
    return lengths


def _strain(length: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Engineering strain against the median length before the load first exceeds :data:`UNLOADED`."""
    loaded = np.flatnonzero(force > UNLOADED)
    before = max(int(loaded[0]), 1) if len(loaded) else len(length)
    return length / np.median(length[:before]) - 1


def _groups(rows: Sequence[_Row], keys: tuple[str, ...]) -> dict[tuple[str, ...], list[_Row]]:
    """Rows by the values of some columns, in order of appearance."""
    groups: dict[tuple[str, ...], list[_Row]] = {}
    for line, row in rows:
        groups.setdefault(tuple((row.get(key) or "").strip() for key in keys), []).append((line, row))
    return groups


def _column(part: Sequence[_Row], name: str, path: Path) -> np.ndarray:
    values = []
    for line, row in part:
        try:
            unknown = name == "transverse_strain" and row[name] == ""
            value = np.nan if unknown else float(row[name])
        except (TypeError, ValueError) as error:
            raise CaphyError(f"{path}: line {line}: {name} must be a number, got {row[name]!r}") from error
        if not np.isfinite(value) and not (np.isnan(value) and name in _ACROSS):
            raise CaphyError(f"{path}: line {line}: {name} must be finite, got {row[name]!r}")
        values.append(value)
    return np.array(values)


def _first_bad(column: np.ndarray) -> int:
    return int(np.argmax(~np.isfinite(column))) + 1
