"""What a stage is, and the fingerprint of what it depends on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import caphy

UNFINISHED: Final = (".partial", ".tmp")
"""Ends of names of files that are being written."""
STRAY: Final = ("Thumbs.db", "desktop.ini")
"""What file managers leave where somebody looked, beside names that begin with a dot."""


@dataclass(frozen=True, eq=False)
class Stage:
    """One piece of work on a run's folder.

    It is done once for the same inputs and options. Stopped halfway, it is run again and may go on from what it left;
    what was left from other inputs is removed first.
    """

    name: str
    """One word; names the stage's files."""
    what: str
    """What it does, for people."""
    run: Callable[[], None]
    """Does it; raises :class:`caphy.errors.CaphyError` where it cannot."""
    inputs: tuple[Path, ...] = ()
    """Files and folders whose content it depends on, wherever they lie and whatever they are called (names within a
    folder are of its content); those that are missing count as empty."""
    outputs: tuple[Path, ...] = ()
    """Files and folders that it writes, and nobody else."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """All else it depends on, ready for JSON."""
    seconds: float = 1.0
    """How long it takes on an idle core of 2024, roughly."""
    timed: bool = False
    """Whether ``seconds`` was set by the user, whatever the machine."""
    may_fail: bool = False
    """Whether the run goes on without it."""
    whole: Callable[[], bool] = lambda: True
    """Whether what it wrote beyond ``outputs``, which depends on the inputs, is all there."""
    of_all: bool = False
    """Whether its outputs tell of all the others: they are removed when another begins, and made anew after it."""

    def parts(self) -> dict[str, str]:
        """What :meth:`key` is of, by names for people."""
        options = {f"the option {name}": json.dumps(value) for name, value in self.options.items()}
        return {str(path): fingerprint(path) for path in self.inputs} | options

    def key(self) -> str:
        """A fingerprint of inputs, options and caphy's version."""
        digest = hashlib.sha256()
        told = {"caphy": caphy.__version__, "stage": self.name, "options": dict(self.options)}
        digest.update(json.dumps(told, sort_keys=True).encode())
        for path in self.inputs:
            digest.update(f"{fingerprint(path)}\n".encode())
        return digest.hexdigest()


def fingerprint(path: Path) -> str:
    """A hash of a file's content, or of the names and contents of all files in a folder and in those linked there."""
    if path.is_dir():
        digest = hashlib.sha256()
        for file in sorted(_files(path, ())):
            if not file.name.endswith(UNFINISHED) and not _is_stray(file):
                digest.update(f"{file.relative_to(path).as_posix()} {fingerprint(file)}\n".encode())
        return digest.hexdigest()
    if not path.is_file():
        return "missing"
    stat = path.stat()
    return _content(str(path), stat.st_size, stat.st_mtime_ns, stat.st_ino)


def _is_stray(file: Path) -> bool:
    """Whether nobody reads a file of such a name: hidden ones, and those of file managers."""
    return file.name.startswith(".") or file.name in STRAY


def _files(folder: Path, above: tuple[Path, ...]) -> Iterator[Path]:
    """All files below a folder; links back to it, or to those ``above`` it, lead nowhere."""
    above = (*above, folder.resolve())
    for path in folder.iterdir():
        if path.is_file():
            yield path
        elif path.is_dir() and path.resolve() not in above:
            yield from _files(path, above)


@lru_cache(maxsize=4096)
def _content(path: str, *_as_of: int) -> str:
    """SHA-256 of a file, kept as long as size, time and inode stay."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
