"""How large archives may be once they are unpacked, asked before anything is: a few kilobytes may hold gigabytes."""

from __future__ import annotations

from pathlib import Path
from typing import Final
from zipfile import BadZipFile, ZipFile

from caphy.errors import CaphyError

MAX_BYTES: Final = 4 * 2**30
"""Largest content read, after decompression."""


def require_unpackable(path: Path) -> None:
    """Raise :class:`CaphyError` where a zip archive, such as an npz, would unpack to more than :data:`MAX_BYTES`.

    What is missing or no such archive is left to its reader.
    """
    try:
        with ZipFile(path) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
    except (OSError, BadZipFile, ValueError, NotImplementedError):
        return
    if size > MAX_BYTES:
        raise CaphyError(
            f"{path}: would unpack to {size / 2**30:.1f} GiB, must be at most {MAX_BYTES / 2**30:.0f}; leave out what "
            "is not needed, or split it"
        )
