"""Arrays out of NumPy archives, never unpickling."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caphy.errors import CaphyError
from caphy.io.unpacked import require_unpackable


class Archive:
    """The arrays of an ``.npz`` file by name, with errors a user can act on."""

    def __init__(self, path: Path):
        self.path = Path(path)
        require_unpackable(self.path)
        try:
            file = np.load(self.path, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise CaphyError(f"{path}: must be an .npz archive of named arrays, got a single array")
            with file:
                self._arrays = {name: _read(file, name) for name in file.files}
        except CaphyError:
            raise
        except Exception as error:  # a damaged archive can fail anywhere in zipfile, zlib or NumPy's headers
            why = "no archive at all" if "allow_pickle" in str(error) else f"perhaps cut short: {error}"
            raise CaphyError(f"{path}: not a readable .npz archive, {why}") from error

    def __contains__(self, name: str) -> bool:
        return name in self._arrays

    @property
    def names(self) -> list[str]:
        """The arrays' names in alphabetical order."""
        return sorted(self._arrays)

    def require(self, *names: str) -> None:
        """Raise :class:`CaphyError` unless every one of ``names`` is in the archive."""
        missing = [name for name in names if name not in self]
        if missing:
            raise CaphyError(f"{self.path}: must hold {', '.join(missing)}; it has {', '.join(self.names)}")

    def floats(self, name: str) -> np.ndarray:
        """The array ``name`` as float64; raises :class:`CaphyError` if it is absent or not numeric."""
        self.require(name)
        values = self._arrays[name]
        if values is None or values.dtype.kind not in "fiu":
            got = "Python objects or no array" if values is None else values.dtype
            raise CaphyError(f"{self.path}: {name} must be numbers, got {got}")
        return values.astype(np.float64)

    def columns(self, name: str, width: int, frames: int) -> np.ndarray:
        """The array ``name`` as (frames, width) float64; zeros where it is absent."""
        if name not in self:
            return np.zeros((frames, width))
        values = self.floats(name)
        if values.size != frames * width:
            raise CaphyError(f"{self.path}: {name} must hold {frames} x {width} values, got shape {values.shape}")
        return values.reshape(frames, width)

    def text(self, name: str, default: str = "") -> str:
        """The scalar text ``name`` (bytes are decoded)."""
        value = self._arrays.get(name)
        if value is None or value.size != 1 or value.dtype.kind not in "US":
            return default
        value = value.reshape(-1)[0]
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _read(file: np.lib.npyio.NpzFile, name: str) -> np.ndarray | None:
    """One array, or none where it is an array of Python objects, which is not unpickled, or no array at all."""
    try:
        found = file[name]  # the bytes of what is no array
        return found if isinstance(found, np.ndarray) else None
    except ValueError as error:
        if "allow_pickle" in str(error):
            return None
        raise
