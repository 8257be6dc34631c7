"""Whether something can be written where a user wants it: asked before the work, not after it."""

from __future__ import annotations

import tempfile
from pathlib import Path

from caphy.errors import CaphyError


def writable_file(path: Path) -> Path:
    """``path``, in whose place a file can be written once its folder is made; raises CaphyError where none can."""
    path = Path(path)
    if path.is_dir():
        raise CaphyError(f"{path}: is a folder, and a file is to be written there; give the file's name too")
    _try(path, path.parent)
    return path


def writable_folder(path: Path) -> Path:
    """``path``, in which files can be written once it is made; raises CaphyError where none can."""
    path = Path(path)
    _try(path, path)
    return path


def _try(path: Path, folder: Path) -> None:
    """Make a file that is removed at once: rights do not tell of full disks and /proc. Nothing is left behind."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not there.is_dir():
        raise CaphyError(f"{path}: cannot be written, since {there} is a file; choose another place")
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise CaphyError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
