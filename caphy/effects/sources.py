"""What a user's effects are made of: their files, what these import from beside them, and what they read."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

_read: dict[Path, set[Path]] = {}  # effect file -> files below its folder that were read while it was loaded
_under_way: list[set[Path]] = []
_INSTALLED = tuple(Path(place).resolve() for place in (sys.prefix, sys.base_prefix, Path(__file__).parents[1]))


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Take note of what an effect file reads and imports: a table of measurements beside it is a part of the effect."""
    _listen()
    found, before = set(), set(sys.modules)
    _under_way.append(found)
    try:
        yield
    finally:
        _under_way.pop()
    imported = (getattr(sys.modules[name], "__file__", None) for name in set(sys.modules) - before)
    files = {Path(file).resolve() for file in (*found, *filter(None, imported))}
    _read.setdefault(path.resolve(), set()).update(file for file in files if _belongs(file, path.resolve().parent))


@cache
def _listen() -> None:
    """Hear of all files that are opened, for as long as Python runs: hooks cannot be removed."""

    def opened(event: str, arguments: tuple) -> None:
        if _under_way and event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            mode = arguments[1] or "r"
            if not set(mode) & set("wax+"):
                _under_way[-1].add(Path(os.path.abspath(os.fsdecode(arguments[0]))))

    sys.addaudithook(opened)


def _belongs(file: Path, folder: Path) -> bool:
    """Whether a file is in or below a folder, and neither Python's, nor ours, nor compiled."""
    ours = any(file.is_relative_to(place) for place in _INSTALLED)
    return file.is_relative_to(folder) and not ours and "__pycache__" not in file.parts


def sources(path: Path) -> list[Path]:
    """The files that an effect file follows from: all code in its folder, what it imported from folders below, and
    what it read there."""
    every = {*path.resolve().parent.glob("*.py"), *_read.get(path.resolve(), ())}
    return sorted(file for file in every if file.is_file())
