"""Garments and avatars that come with caphy, by name."""

from __future__ import annotations

from pathlib import Path

import caphy

_DATA = Path(caphy.__file__).parent / "data"


def bundled(path: Path) -> Path:
    """The bundled garment or avatar of that name, or the path itself."""
    known = [_DATA / "garments" / f"{path}.npz", _DATA / "avatars" / path]
    return path if path.exists() else next((one for one in known if one.exists()), path)
