"""One door for every pose file: the format is told by the file itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from caphy.errors import CaphyError
from caphy.io.poses.archive import Archive
from caphy.io.poses.canonical import is_canonical, read_canonical
from caphy.io.poses.sequence import PoseSequence


def read_poses(path: str | Path, *, fps: float | None = None) -> PoseSequence:
    """The motion in a pose file, y up, whatever its format.

    Formats: caphy's own ``.npz``; CMU ``.bvh`` (retargeted to the bundled body). ``fps`` [Hz] is the true frame rate,
    needed where the file does not say.

    Raises :class:`CaphyError`, naming file, frame and joint, for anything else.
    """
    path = Path(path)
    if not path.exists():
        raise CaphyError(f"{path}: no such file")
    readers: dict[str, Callable[[Path, float | None], PoseSequence]] = {".npz": _read_npz, ".bvh": _read_cmu_bvh}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise CaphyError(f"{path}: pose files end in {', '.join(readers)}; got {path.suffix or 'no suffix'}")
    return reader(path, fps).to_y_up()


def _read_npz(path: Path, fps: float | None) -> PoseSequence:
    archive = Archive(path)
    if is_canonical(archive):
        return read_canonical(archive)
    raise CaphyError(f"{path}: not a pose file of caphy; it has {', '.join(archive.names)}")


def _read_cmu_bvh(path: Path, fps: float | None) -> PoseSequence:
    from caphy.io.poses.cmu import read_cmu_bvh

    return read_cmu_bvh(path, fps)
