"""Results of SMPLer-X (Cai et al., NeurIPS 2023): a folder with one ``.npz`` per frame and person.

Files are named FRAME_PERSON.npz; the person's number is the place in that frame's detections, not a track.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.archive import Archive
from caphy.io.poses.camera import level_camera
from caphy.io.poses.estimated import estimated
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.smpl import require_fps
from caphy.io.poses.smplx_npz import parts_of_pose


def read_smplerx(folder: Path, fps: float | None, person: int | None = None) -> PoseSequence:
    """One person's motion from a folder of frames; ``fps`` [Hz] must be given. Raises :class:`CaphyError`."""
    fps = require_fps(fps, str(folder), "frames in separate files have no frame rate")
    files, person = _files(folder, person)
    poses, transl, betas = [], [], []
    for path in files.values():
        archive = Archive(path)
        archive.require("global_orient", "body_pose", "transl")
        poses.append(parts_of_pose(archive, 1)[0])
        transl.append(archive.columns("transl", 3, 1))
        betas.append(archive.floats("betas").ravel() if "betas" in archive else np.zeros(10))
    if len({len(row) for row in betas}) != 1:
        raise CaphyError(f"{folder}: betas differ in length from frame to frame")
    return level_camera(
        estimated(
            folder,
            fps,
            np.concatenate(poses),
            np.concatenate(transl),
            np.array(list(files)),
            np.array(betas),
            notes=(f"detection {person} of each frame; detections are not tracked",),
        )
    )


def _files(folder: Path, person: int | None) -> tuple[dict[int, Path], int]:
    """The chosen person's file of each frame, in order of frames."""
    named = [(re.fullmatch(r"(?:.*?)(\d+)(?:_(\d+))?", path.stem), path) for path in sorted(folder.glob("*.npz"))]
    found = [(int(match[2] or 0), int(match[1]), path) for match, path in named if match]
    persons = sorted({number for number, _, _ in found})
    if not found:
        raise CaphyError(f"{folder}: holds no files named FRAME_PERSON.npz")
    if person is None and len(persons) > 1:
        raise CaphyError(
            f"{folder}: up to {len(persons)} persons per frame, and they are not tracked; "
            "choose with 'caphy poses convert --person'"
        )
    person = persons[0] if person is None else person
    files = {frame: path for number, frame, path in found if number == person}
    if not files:
        raise CaphyError(f"{folder}: there is no person {person}; it has {', '.join(map(str, persons))}")
    return dict(sorted(files.items())), person
