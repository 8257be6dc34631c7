"""One door for every pose file: the format is told by the file itself."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from caphy.errors import CaphyError
from caphy.io.poses.archive import Archive
from caphy.io.poses.canonical import is_canonical, read_canonical
from caphy.io.poses.sequence import PoseSequence, require_rate
from caphy.io.poses.smplx_npz import read_smplx_npz

SUFFIXES = (".npz", ".bvh", ".amc", ".pt", ".pkl", ".npy")


def read_poses(
    path: str | Path,
    *,
    fps: float | None = None,
    up: Literal["y", "z"] | None = None,
    person: int | None = None,
) -> PoseSequence:
    """The motion in a pose file, y up, whatever its format.

    ``.npz``: caphy's own, AMASS SMPL-H and SMPL-X, plain SMPL-X. ``.bvh`` and ``.amc``: the CMU skeleton, retargeted
    to the bundled body. ``.pt``: GVHMR. ``.pkl``: WHAM, PHALP (4D-Humans), PyMAF-X. ``.npy``: TRAM. A folder of
    ``.npz``: SMPLer-X.

    ``fps`` [Hz] is the true frame rate, needed where the file does not say; ``up`` its up axis; ``person`` whom to
    take of several. What had to be assumed is in the sequence's ``notes``. Raises :class:`CaphyError`, naming file,
    frame and joint, for anything else.
    """
    path = Path(path)
    if not path.exists():
        raise CaphyError(f"{path}: no such file")
    if fps is not None:
        require_rate(fps, str(path))
    return _read(path, fps, up, person).to_y_up()


def _read(path: Path, fps: float | None, up: Literal["y", "z"] | None, person: int | None) -> PoseSequence:
    """Imports lie here because the CMU readers load the bundled body."""
    if path.is_dir():
        from caphy.io.poses.smplerx import read_smplerx

        return read_smplerx(path, fps, person)
    match path.suffix.lower():
        case ".npz":
            _require_one(path, person)
            archive = Archive(path)
            return read_canonical(archive, fps, up) if is_canonical(archive) else read_smplx_npz(archive, fps, up)
        case ".bvh":
            _require_one(path, person)
            from caphy.io.poses.cmu import read_cmu_bvh

            return read_cmu_bvh(path, fps, up)
        case ".amc":
            _require_one(path, person)
            from caphy.io.poses.cmu import read_cmu_amc

            return read_cmu_amc(path, fps, up)
        case ".pt" | ".pkl" | ".npy":
            if up is not None:
                raise CaphyError(f"{path}: results of estimators say their axes themselves; leave --up out")
            return _read_estimated(path, fps, person)
    raise CaphyError(f"{path}: pose files end in {', '.join(SUFFIXES)}; got {path.suffix or 'no suffix'}")


def _require_one(path: Path, person: int | None) -> None:
    if person is not None:
        raise CaphyError(f"{path}: holds one person; leave --person out")


def _read_estimated(path: Path, fps: float | None, person: int | None) -> PoseSequence:
    """What an estimator of poses wrote; of pickles the content tells which."""
    from caphy.io.pickles import read_pickle
    from caphy.io.poses.gvhmr import read_gvhmr
    from caphy.io.poses.phalp import is_phalp, read_phalp
    from caphy.io.poses.pymafx import is_pymafx, read_pymafx
    from caphy.io.poses.tram import read_tram
    from caphy.io.poses.wham import read_wham

    if path.suffix.lower() in (".pt", ".npy"):
        _require_one(path, person)
        return read_gvhmr(path, fps) if path.suffix.lower() == ".pt" else read_tram(path, fps)
    results = read_pickle(path)
    if is_phalp(results):
        return read_phalp(results, path, fps, person)
    if is_pymafx(results):
        return read_pymafx(results, path, fps, person)
    return read_wham(results, path, fps, person)
