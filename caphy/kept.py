"""What was rolled out and registered, kept on disk until the answer is there: work that was stopped goes on from it."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

import numpy as np

import caphy
from caphy.effects.sources import sources
from caphy.errors import CaphyError
from caphy.garment.template import read_npz, write_npz

PACKAGE = Path(caphy.__file__).parent


class Kept:
    """A folder of arrays, each file named by a digest of all that they follow from; without one nothing is kept."""

    def __init__(self, folder: Path | None = None, effect_files: Sequence[Path] = ()) -> None:
        """``effect_files``: the user's own effects, registered before: they count with all that they follow from."""
        self.folder = folder
        self._failed = False
        self._code = "" if folder is None else digest(own_code(), code(effect_files))

    def key(self, *of: object) -> str:
        """The name of what follows from ``of``, caphy's own code and the user's effects."""
        return "" if self.folder is None else digest(self._code, *of)

    def recall(self, key: str) -> dict[str, np.ndarray] | None:
        """What was kept by that name; nothing where there is none, or half of it."""
        if self.folder is None or not (path := self.folder / f"{key}.npz").is_file():
            return None
        try:
            return read_npz(path)
        except CaphyError:  # damaged: it is made again
            return None

    def keep(self, key: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Write arrays by that name, at once or not at all: a full disk does not end the work, only what is kept; it
        is said once."""
        if self.folder is None:
            return
        try:
            write_npz(self.folder / f"{key}.npz", arrays, compressed=False)  # what was computed hardly shrinks
        except CaphyError as error:
            if not self._failed:
                print(f"unfinished work cannot be kept there: {error}", file=sys.stderr)
            self._failed = True


@cache
def own_code() -> str:
    """A digest of caphy's code and of the data that come with it (bodies, garments, fabrics, the default avatar), as
    they are when this process first asks."""
    files = [file for file in (*PACKAGE.rglob("*.py"), *(PACKAGE / "data").rglob("*")) if file.is_file()]
    return digest([file.read_bytes() for file in sorted(files)])


def code(effect_files: Sequence[Path]) -> list[bytes]:
    """What the user's effects, which were registered before, follow from."""
    return [file.read_bytes() for file in sorted({file for effect in effect_files for file in sources(effect)})]


def digest(*values: object) -> str:
    """SHA-256 of plain values, arrays, and containers and dataclasses of them, the same in every process.

    Raises TypeError for anything else, whose content cannot be told.
    """
    told = hashlib.sha256()
    for part in _parts(values):
        told.update(len(part).to_bytes(8, "little") + part)
    return told.hexdigest()


def _parts(value: object) -> Iterator[bytes]:
    yield type(value).__name__.encode()
    if value is None or isinstance(value, bool | int | float | str | Path):
        yield repr(value).encode()
    elif isinstance(value, bytes):
        yield value
    elif isinstance(value, np.ndarray | np.generic):
        yield f"{value.dtype.str} {value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, Mapping):
        yield str(len(value)).encode()
        for key in sorted(value, key=repr):
            yield from _parts(key)
            yield from _parts(value[key])
    elif isinstance(value, set | frozenset):
        yield from _parts(sorted(value, key=repr))
    elif isinstance(value, list | tuple):
        yield str(len(value)).encode()
        for each in value:
            yield from _parts(each)
    elif is_dataclass(value):
        for field in fields(value):
            yield field.name.encode()
            yield from _parts(getattr(value, field.name))
    else:
        raise TypeError(f"cannot tell the content of {type(value).__name__}")
