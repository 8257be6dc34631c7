"""Caphy's own pose file: a pickle-free ``.npz`` that says what its numbers mean."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.places import new_file
from caphy.io.poses.archive import Archive
from caphy.io.poses.sequence import PoseSequence

SCHEMA: Final = "caphy-poses"
VERSION: Final = 1


def write_poses(sequence: PoseSequence, path: Path) -> None:
    """Write a sequence as ``.npz``, whole or not at all; float64, nothing is lost."""
    path = Path(path)
    if path.suffix != ".npz":
        raise CaphyError(f"{path}: a pose file's name must end in .npz")
    header = {
        "schema": SCHEMA,
        "version": VERSION,
        "units": {"poses": "rad, axis-angle", "transl": "m", "pelvis": "m", "fps": "Hz"},
        "joints": JOINT_NAMES,
        "fps": sequence.fps,
        "up_axis": sequence.up_axis,
        "frame": sequence.frame,
        "model": sequence.model,
        "source": sequence.source,
        "notes": sequence.notes,
    }
    names = ("poses", "transl", "pelvis", *(() if sequence.betas is None else ("betas",)))
    arrays: dict[str, Any] = {name: getattr(sequence, name) for name in names}
    if sequence.unseen is not None:
        arrays["unseen"] = sequence.unseen.astype(np.uint8)
    with new_file(path) as file:
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


def is_canonical(archive: Archive) -> bool:
    """Whether the archive was written by :func:`write_poses`."""
    return SCHEMA in archive.text("header")


def read_canonical(archive: Archive, fps: float | None = None, up: Literal["y", "z"] | None = None) -> PoseSequence:
    """The sequence in a file of :func:`write_poses`; ``fps`` [Hz] overrides the file's. A note says of what it is.

    Raises :class:`CaphyError`.
    """
    try:
        header = json.loads(archive.text("header"))
        version, joints = header["version"], tuple(header["joints"])
        fields = {name: header[name] for name in ("fps", "up_axis", "frame", "model")}
        notes, origin = tuple(header["notes"]), header["source"]
    except (ValueError, KeyError, TypeError) as error:
        raise CaphyError(f"{archive.path}: its header cannot be understood: {error!r}") from error
    if version != VERSION:
        raise CaphyError(f"{archive.path}: schema version must be {VERSION}, got {version}; update caphy")
    if joints != JOINT_NAMES:
        raise CaphyError(f"{archive.path}: joints must be SMPL-X's 55 in order, got {len(joints)} others")
    if up not in (None, fields["up_axis"]):
        raise CaphyError(f"{archive.path}: says that {fields['up_axis']} is up, which stands; got up = {up!r}")
    if fps is not None and fps != fields["fps"]:
        notes = (*notes, f"frame rate {fps:g} replaces the file's {fields['fps']:g}")
        fields["fps"] = fps
    if origin and (said := f"made from {origin}") not in notes:
        notes = (*notes, said)
    return PoseSequence(
        source=str(archive.path),
        poses=archive.floats("poses"),
        transl=archive.floats("transl"),
        pelvis=archive.floats("pelvis"),
        betas=archive.floats("betas") if "betas" in archive else None,
        notes=notes,
        unseen=archive.floats("unseen") != 0 if "unseen" in archive else None,
        **fields,
    )
