"""Results of 4D-Humans (Goel et al., ICCV 2023): ``demo_*.pkl``, written by PHALP through joblib.

A dictionary by frame name: ``time`` (number of the frame), ``tid`` (tracks), ``tracked_time`` (frames since each was
seen; the rest of such an entry is old), ``smpl`` (each {global_orient (1, 3, 3), body_pose (23, 3, 3), betas}),
``camera`` ((3,) translation [m], for pictures padded to squares of 256 pixels and a focal length of 5000 of them),
``size`` (height, width [pixels]). In the camera's axes, SMPL's 24 joints.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.camera import at_usual_distance, level_camera
from caphy.io.poses.estimated import estimated
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.smpl import axis_angles, poses_from_columns, require_fps

FOCAL: Final = 5000.0 / 256.0
"""PHALP's focal length, in sides of its square."""
EACH: Final = ("tid", "tracked_time", "smpl", "camera", "size")
"""Lists of a frame, one entry for each person."""


def is_phalp(results: Any) -> bool:
    """Whether a pickle's content is PHALP's."""
    frames = list(results.values()) if isinstance(results, dict) else []
    return bool(frames) and all(isinstance(frame, dict) and {"tid", "smpl"} <= frame.keys() for frame in frames)


def read_phalp(results: dict[str, Any], path: Path, fps: float | None, person: int | None = None) -> PoseSequence:
    """One track's motion; ``fps`` [Hz] is the video's and must be given. Raises :class:`CaphyError`."""
    fps = require_fps(fps, str(path), "PHALP does not keep the video's frame rate")
    frames = [_checked(name, frame, path) for name, frame in results.items()]
    person = _track(frames, path, person)
    seen = list(_of(frames, person, path))
    poses, model, notes = poses_from_columns(np.array([found[1] for found in seen]).reshape(len(seen), 72), str(path))
    numbers, betas, transl = (np.array([found[i] for found in seen]) for i in (0, 2, 3))
    said = (f"track {person}", *notes, "distance as of a focal length of the diagonal")
    return level_camera(estimated(path, fps, poses, transl, numbers, betas, model, said))


def _checked(name: str, frame: dict[str, Any], path: Path) -> dict[str, Any]:
    lengths = {key: len(frame[key]) if isinstance(frame.get(key), list) else -1 for key in EACH}
    if len(set(lengths.values())) != 1 or -1 in lengths.values() or not isinstance(frame.get("time"), int):
        got = ", ".join(f"{key} {length}" for key, length in lengths.items())
        raise CaphyError(f"{path}: {name}: must hold time, and lists of one length {', '.join(EACH)}; got {got}")
    return frame


def _track(frames: list[dict[str, Any]], path: Path, person: int | None) -> int:
    """The chosen track, or the only one."""
    counts = Counter(
        int(track)
        for frame in frames
        for track, since in zip(frame["tid"], frame["tracked_time"], strict=True)
        if since == 0
    )
    listed = ", ".join(f"{track} ({count} frames)" for track, count in counts.most_common(8))
    if not counts:
        raise CaphyError(f"{path}: nobody was tracked in its {len(frames)} frames")
    if person is None and len(counts) > 1:
        raise CaphyError(f"{path}: holds {len(counts)} tracks: {listed}; choose with 'caphy poses convert --person'")
    person = next(iter(counts)) if person is None else person
    if person not in counts:
        raise CaphyError(f"{path}: there is no track {person}; it holds {listed}")
    return person


def _of(
    frames: list[dict[str, Any]], person: int, path: Path
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Number, rotation vectors (24, 3), betas and translation (3,) of every frame in which the track was seen."""
    for frame in frames:
        for i, track in enumerate(frame["tid"]):
            if int(track) != person or frame["tracked_time"][i] != 0:
                continue
            where = f"{path}: frame {frame['time']}"
            smpl = frame["smpl"][i]
            if not isinstance(smpl, dict) or not {"global_orient", "body_pose", "betas"} <= smpl.keys():
                raise CaphyError(f"{where}: smpl must hold global_orient, body_pose and betas")
            parts = [
                _numbers(smpl[key], (count, 3, 3), where) for key, count in (("global_orient", 1), ("body_pose", 23))
            ]
            height, width = _numbers(frame["size"][i], (2,), where)
            side = max(height, width)
            place = at_usual_distance(
                _numbers(frame["camera"][i], (3,), where), FOCAL * side, np.array([width, height])
            )
            yield frame["time"], axis_angles(np.concatenate(parts), where), np.ravel(smpl["betas"]), place
            break


def _numbers(values: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    found = np.asarray(values)
    if found.dtype.kind not in "fiu" or found.size != int(np.prod(shape)):
        raise CaphyError(f"{where}: must hold numbers of shape {shape}, got {found.dtype} of shape {found.shape}")
    return found.astype(np.float64).reshape(shape)
