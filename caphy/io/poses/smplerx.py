"""Results of SMPLer-X (Cai et al., NeurIPS 2023): a folder with one ``.npz`` per frame and person.

Files are named FRAME_PERSON.npz; the person's number is the place in that frame's detections, not a track. Their
``transl`` is in a camera of each detection's own crop, whose focal length follows the crop's size: it tells neither
where a person stands nor how far away.
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

_NAME = re.compile(r"(?:.*?)(\d+)(?:_(\d+))?")


def read_smplerx(folder: Path, fps: float | None, person: int | None = None) -> PoseSequence:
    """One person's motion from a folder of frames; ``fps`` [Hz] must be given. Raises :class:`CaphyError`."""
    files, person = _files(folder, person)
    fps = require_fps(fps, str(folder), "frames in separate files have no frame rate")
    poses, betas = [], []
    for path in files.values():
        archive = Archive(path)
        archive.require("global_orient", "body_pose")
        poses.append(parts_of_pose(archive, 1)[0])
        betas.append(archive.floats("betas").ravel() if "betas" in archive else np.zeros(10))
    if len({len(row) for row in betas}) != 1:
        raise CaphyError(f"{folder}: betas differ in length from frame to frame")
    return level_camera(
        estimated(
            folder,
            fps,
            np.concatenate(poses),
            np.zeros((len(poses), 3)),
            np.array(list(files)),
            np.array(betas),
            notes=(
                f"detection {person} of each frame; detections are not tracked",
                "translations are of each crop's own camera, and left out; condition it with translation feet",
            ),
        )
    )


def _is_of_one_frame(archive: Archive) -> bool:
    """Whether it holds the pose of 21 joints once."""
    return "body_pose" in archive and archive.floats("body_pose").size == 63


def _files(folder: Path, person: int | None) -> tuple[dict[int, Path], int]:
    """The chosen person's file of each frame, in order of frames."""
    named = [(_NAME.fullmatch(path.stem), path) for path in sorted(folder.glob("*.npz"))]
    found = [(int(match[2] or 0), int(match[1]), path) for match, path in named if match]
    persons = sorted({number for number, _, _ in found})
    if not found or not _is_of_one_frame(Archive(found[0][2])):
        raise CaphyError(
            f"{folder}: is a folder, and only one with a file FRAME_PERSON.npz for each frame (SMPLer-X) is a motion; "
            "name the motions in it one by one"
        )
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
