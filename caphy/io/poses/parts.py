"""Stretches of motions, under names that tell where in its file each lies: ``walk.bvh#120-480``."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from caphy.errors import CaphyError
from caphy.io.poses.read import read_poses
from caphy.io.poses.sequence import PoseSequence

_FRAMES = re.compile(r"#(\d+)-(\d+)$")


def part(sequence: PoseSequence, start: int, stop: int) -> PoseSequence:
    """Frames ``start`` to ``stop``, the last one left out, named by where they lie in the sequence's file."""
    found = _FRAMES.search(sequence.source)
    first = int(found[1]) if found else 0
    return replace(
        sequence[start:stop], source=f"{file_of(sequence.source)}#{first + start}-{first + min(stop, len(sequence))}"
    )


def file_of(source: str) -> str:
    """The file of a motion's source, which may be a part of it."""
    return _FRAMES.sub("", source)


def placed(source: str) -> str:
    """The source of a motion as it is found from any folder; of one that is no file as it is."""
    path = file_of(source)
    return str(Path(path).resolve()) + source[len(path) :] if Path(path).is_file() else source


def read_part(source: str) -> PoseSequence:
    """A motion by its source: a pose file, or the part of it that :func:`part` names.

    Raises:
        CaphyError: the file cannot be read, or is shorter than the part was.
    """
    path, found = file_of(source), _FRAMES.search(source)
    whole = replace(read_poses(Path(path)), source=path)
    if found is None:
        return whole
    start, stop = int(found[1]), int(found[2])
    if not start < stop <= len(whole):
        raise CaphyError(f"{path}: must have the frames {start} to {stop - 1} that were asked for, has {len(whole)}")
    return part(whole, start, stop)
