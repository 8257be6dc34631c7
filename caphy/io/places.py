"""Whether something can be written where a user wants it, asked before the work; and files written whole or not at
all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from caphy.errors import CaphyError


def writable_file(path: Path, suffix: str = "", inputs: Iterable[str | Path] = ()) -> Path:
    """``path``, in whose place a file can be written once its folder is made.

    Args:
        suffix: what its name must end in.
        inputs: files that are read, whose place it must not take; names of what is no file are passed over.

    Raises:
        CaphyError: none can be written there.
    """
    path = Path(path)
    if path.suffix.lower() != (suffix or path.suffix.lower()):
        raise CaphyError(f"{path}: what is written there is {suffix[1:].upper()}, so its name must end in {suffix}")
    if path.exists() and any(Path(each).exists() and path.samefile(each) for each in inputs):
        raise CaphyError(f"{path}: is read, and would be replaced by what is written; give another name")
    if path.is_dir():
        raise CaphyError(f"{path}: is a folder, and a file is to be written there; give the file's name too")
    if path.exists() and not path.is_file():
        raise CaphyError(f"{path}: must be a file, and is a device or the like, which would be replaced")
    _try(path, path.parent)
    return path


def writable_folder(path: Path) -> Path:
    """``path``, in which files can be written once it is made; raises CaphyError where none can."""
    path = Path(path)
    _try(path, path)
    return path


def _try(path: Path, folder: Path) -> None:
    """Make a file that is removed at once: rights do not tell of full disks and /proc. Nothing is left behind."""
    there = next(place for place in (folder, *folder.absolute().parents) if os.path.lexists(place))
    if not there.is_dir():
        kind = "a file" if there.exists() else "a link to what is not there"
        raise CaphyError(f"{path}: cannot be written, since {there} is {kind}; choose another place")
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise CaphyError(f"{path}: cannot be written ({error.strerror}); choose another place") from error


def write_text(path: Path, text: str) -> None:
    """Write a text file as :func:`write_bytes` does."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file, whole or not at all; its folder is made. Raises :class:`CaphyError` where that fails."""
    with new_file(path) as file:
        file.write(content)


@contextmanager
def new_file(path: Path) -> Iterator[IO[bytes]]:
    """A file to write to, which takes the place of ``path`` at the end, whole or not at all; its folder is made.

    Raises :class:`CaphyError` where that fails, a full disk for one.
    """
    with _told(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, partial = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-", suffix=".partial")
        try:
            with os.fdopen(handle, "wb") as file:
                yield file
            os.chmod(partial, 0o644)
            os.replace(partial, path)
        except BaseException:
            Path(partial).unlink(missing_ok=True)
            raise


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder to fill, which takes the place of ``folder`` at the end, whole or not at all; see :func:`swap`.

    Raises :class:`CaphyError` where that fails, a full disk for one.
    """
    with _told(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            yield partial
            partial.chmod(0o755)
            swap(partial, folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """What the system says against writing, with the place and what to do."""
    try:
        yield
    except OSError as error:
        why = f"cannot be written ({error.strerror or error}); free space, or choose another place"
        raise CaphyError(f"{path}: {why}") from error


def swap(new: Path, folder: Path) -> None:
    """Put directory ``new`` in the place of ``folder``; what stood there ends up in ``new``'s place.

    A reader sees either, or for the instant between two renamings none, never a mixture.
    """
    if not folder.exists():
        os.replace(new, folder)
        return
    aside = new.with_name(f"{new.name}.old")
    os.replace(folder, aside)
    try:
        os.replace(new, folder)
    except OSError:
        os.replace(aside, folder)
        raise
    os.replace(aside, new)
