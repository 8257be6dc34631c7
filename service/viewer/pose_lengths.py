"""How much a pose file says it holds: told by headers, before any number of it is unpacked or read."""

from __future__ import annotations

import math
import re
import zipfile
from io import BytesIO
from typing import Final

from numpy.lib import format as npy

from service.errors import Problem

MAX_UNPACKED_BYTES: Final = 128 << 20
MAX_FRAMES: Final = 36_000
"""300 s at 120 Hz."""
NUMBER_BYTES: Final = 8
"""Of a number as the readers hold it, however few an archive takes for it."""
JOINT_BYTES: Final = 72
"""Of a joint's rotation in a frame as the reader of ``.bvh`` holds it."""
TRIPLES: Final = ("trans", "transl", "root_orient", "global_orient")
"""Arrays of three numbers for every frame; ``poses`` has a row."""
FRAMES: Final = re.compile(r"MOTION\s+Frames:\s*(\S+)")


def require_short(name: str, content: bytes) -> None:
    """Raise Problem 413 where the ``.npz`` or ``.bvh`` says that it holds too much, 422 where an ``.npz`` is none."""
    size, frames = _of_bvh(content) if name.lower().endswith(".bvh") else _of_archive(name, content)
    if frames > MAX_FRAMES:
        raise Problem(413, f"{name}: a motion here may have {MAX_FRAMES} frames, this one says {frames:.0f}; cut it")
    if size > MAX_UNPACKED_BYTES:
        raise Problem(413, f"{name}: a file may unpack to {MAX_UNPACKED_BYTES} bytes, this one says {size:.0f}")


def _of_archive(name: str, content: bytes) -> tuple[float, float]:
    """Bytes and frames; zipfile and NumPy hold archives to what they claim."""
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > MAX_UNPACKED_BYTES:
                return size, 0
            shapes = [(member.filename.removesuffix(".npy"), _shape(archive, member)) for member in members]
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise Problem(422, f"{name}: not a readable .npz archive, perhaps cut short: {error}") from error
    numbers = sum(max(0, math.prod(shape)) for _, shape in shapes)
    return max(size, NUMBER_BYTES * numbers), max((_frames(part, shape) for part, shape in shapes), default=0)


def _shape(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> tuple[int, ...]:
    """Of one array; none for what is no array, or damaged in any way: its reader says so."""
    try:
        with archive.open(member) as file:
            read = npy.read_array_header_1_0 if npy.read_magic(file) == (1, 0) else npy.read_array_header_2_0
            shape, _, dtype = read(file)
            return *shape, *dtype.shape
    except Exception:  # anywhere in zipfile, zlib or NumPy's headers
        return ()


def _frames(part: str, shape: tuple[int, ...]) -> int:
    if part in TRIPLES:
        return math.prod(shape) // 3
    return shape[0] if part == "poses" and shape else 0


def _of_bvh(content: bytes) -> tuple[float, float]:
    """Bytes and frames; the reader holds files to what they claim."""
    said = FRAMES.search(content.decode(errors="replace"))
    try:
        frames = float(said[1]) if said else 0.0
    except ValueError:  # the reader says so
        return 0, 0
    return JOINT_BYTES * frames * (1 + content.count(b"JOINT")), frames
