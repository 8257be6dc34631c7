"""Where work that was stopped lies until the same command goes on from it."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

UNFINISHED = "unfinished"
"""Name of that folder in a folder of results; beside a file, the ending of its name."""


@contextmanager
def unfinished(folder: Path) -> Iterator[Path]:
    """A folder for what hours of work found; it goes when they end well, and the same command goes on from it else."""
    if folder.is_dir():
        print(f"going on from what an earlier run left in {folder}")
    try:
        yield folder
    except KeyboardInterrupt:
        if folder.is_dir():
            print(f"\nstopped; the same command goes on from {folder}", file=sys.stderr)
        raise
    shutil.rmtree(folder, ignore_errors=True)
