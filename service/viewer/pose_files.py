"""Pose files that strangers upload: read by caphy's own readers, never unpickled, never larger than said."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle
from caphy.io.poses import PoseSequence, placed_on, read_poses
from service.errors import Problem
from service.protocol import FramesRequest, encode_request
from service.viewer.pose_lengths import require_short

SUFFIXES: Final = (".npz", ".bvh")
"""Formats without code in them; .pkl and .pt may run code when read, so they are converted offline."""
MAX_SECONDS: Final = 300.0
DAMAGE: Final = (ArithmeticError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError)
"""How a reader may fail on a file that is damaged in a way nobody thought of; never the service's fault."""
MEMORY: Final = "/dev/shm"
"""A place for files where nothing else can be written, as in a container with ``--read-only``."""
NOTES_HEADER: Final = "caphy-notes"
SOURCE_HEADER: Final = "caphy-source"
MOST_TOLD: Final = 4000
"""Characters of notes, and of a source, that go into a header: clients refuse long ones."""


def read_upload(name: str, content: bytes, bundle: AvatarBundle, fps: float | None = None) -> PoseSequence:
    """The motion in an uploaded file, on the avatar's body and ground, at its frame rate.

    ``name`` tells the format by its ending; ``fps`` [Hz] is the true frame rate where the file does not say. Raises
    Problem: 413 for what is too long or unpacks to too much, 415 for other formats, 422 for what cannot be read, 503
    where the service can write nowhere.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise Problem(
            415,
            f"pose files here end in {' or '.join(SUFFIXES)}, got {suffix[:16]!r}; convert others on your own machine "
            "with 'caphy poses convert', because files of Python objects may hold code",
        )
    require_short(name, content)
    with _folder_of(f"upload{suffix}", content) as folder:
        return _read(Path(folder, f"upload{suffix}"), name, bundle, fps)


def frames_request(sequence: PoseSequence) -> tuple[bytes, dict[str, str]]:
    """The motion as the body of a frames request (docs/protocol.md), and headers that say where it is from."""
    body = encode_request(FramesRequest(sequence.poses, sequence.transl, sequence.fps, np.zeros(0)))
    notes = [note[:MOST_TOLD] for note in sequence.notes]
    while len(json.dumps(notes)) > 2 * MOST_TOLD:
        notes.pop()
    headers = {SOURCE_HEADER: json.dumps(sequence.source[:MOST_TOLD]), NOTES_HEADER: json.dumps(notes)}
    return body, headers


def _folder_of(name: str, content: bytes) -> TemporaryDirectory[str]:
    """A folder with that file, for readers take paths; raises Problem 503 where there is no place for it."""
    for place in (None, MEMORY):
        try:
            folder = TemporaryDirectory(prefix="caphy-", dir=place)
        except OSError:
            continue
        try:
            Path(folder.name, name).write_bytes(content)
            return folder
        except OSError:
            folder.cleanup()
    raise Problem(
        503, f"a pose file is read from a temporary file, and the service can write none; whoever runs it can set "
        f"TMPDIR to a folder with {len(content)} bytes free, or mount {MEMORY}",
    )  # fmt: skip


def _read(path: Path, name: str, bundle: AvatarBundle, fps: float | None) -> PoseSequence:
    """The motion on the avatar's body, with the uploaded file's own name in the place of the temporary one in all that
    is said."""
    try:
        sequence = read_poses(path, fps=fps)
        if sequence.frame == "camera":
            raise Problem(422, f"{name}: these poses are in a camera's frame; convert them to world coordinates first")
        if (seconds := sequence.duration) > MAX_SECONDS:
            raise Problem(413, f"{name}: a motion here may last {MAX_SECONDS:g} s, got {seconds:.0f} s; cut it")
        sole = float(bundle.body.vertices[:, 1].min())
        sequence = placed_on(sequence.to_y_up(), bundle.joints, sole).resample(bundle.fps)
    except Problem:
        raise
    except CaphyError as error:
        said = str(error).replace(str(path), name).replace(" with 'caphy poses convert --fps RATE'", "")
        raise Problem(422, said) from error
    except DAMAGE as error:
        raise Problem(422, f"{name}: cannot be read as a pose file ({type(error).__name__})") from error
    notes = tuple(note.replace(str(path), name) for note in sequence.notes)
    return PoseSequence(**{**vars(sequence), "source": name, "notes": notes})
