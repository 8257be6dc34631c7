"""Garments and avatars that come with caphy, by name, and as records name them wherever caphy is installed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import caphy

OURS: Final = "caphy:"
"""How the path of what comes with caphy begins in a record."""
_DATA: Final = Path(caphy.__file__).resolve().parent / "data"


def bundled(path: Path) -> Path:
    """The bundled garment or avatar of that name, or the path itself."""
    known = [_DATA / "garments" / f"{path}.npz", _DATA / "avatars" / path]
    return path if path.exists() else next((one for one in known if one.exists()), path)


def recorded(path: Path) -> str | None:
    """What a record says of something that comes with caphy; nothing of all else."""
    path = path.resolve()
    return f"{OURS}{path.relative_to(_DATA).as_posix()}" if path.is_relative_to(_DATA) else None


def path_of(told: str, folder: Path) -> Path:
    """The path that a record in a folder tells: of what comes with caphy, relative to the folder, or whole."""
    return _DATA / told.removeprefix(OURS) if told.startswith(OURS) else Path(os.path.normpath(folder / told))
