"""Where work that was stopped lies until the same command goes on from it."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from caphy.errors import CaphyError

UNFINISHED = "unfinished"
"""Name of that folder in a folder of results; beside a file, the ending of its name."""

_OURS = re.compile(r"\.?([0-9a-f]{64}|[a-z]+-[a-z_]+-\d+-[0-9a-f]{20})\.npz")
"""How names begin of what :class:`caphy.kept.Kept` writes and of films of a challenge; with a dot while they are
written (:func:`caphy.io.places.new_file`), which a kill leaves so."""


@contextmanager
def unfinished(folder: Path) -> Iterator[Path]:
    """A folder for what hours of work found; it goes when they end well, and the same command goes on from it else.

    Raises :class:`CaphyError` where there is such a folder with something else in it.
    """
    if folder.is_dir():
        if foreign := sorted(path.name for path in folder.iterdir() if not _OURS.match(path.name)):
            raise CaphyError(
                f"{folder}: is where unfinished work is kept, and holds {foreign[0]!r}, which is not caphy's; move it "
                "elsewhere, or choose another output"
            )
        print(f"{folder} holds what an earlier run left; what was found from the same is not done again")
    try:
        yield folder
    except KeyboardInterrupt:
        if folder.is_dir():
            print(f"\nstopped; the same command goes on from {folder}", file=sys.stderr)
        raise
    with suppress(OSError):  # not there, or somebody has put something into it meanwhile
        for path in folder.iterdir():
            if _OURS.match(path.name):
                path.unlink()
        folder.rmdir()
