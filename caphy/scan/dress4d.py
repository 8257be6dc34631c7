"""Scans in 4D-DRESS's layout (Wang et al., CVPR 2024), converted offline; its pickles go through the allow-list.

A take is a folder with ``Meshes_pkl/mesh-fNNNNN.pkl`` (vertices, faces, uvs, perhaps colors), ``atlas-fNNNNN.pkl`` (the
texture), ``Semantic/labels/label-fNNNNN.pkl`` (scan_labels) and ``SMPLX/mesh-fNNNNN_smplx.pkl``. Metres, y up.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError
from caphy.io.pickles import read_pickle
from caphy.io.poses import PoseSequence
from caphy.scan.scan import BODY, LOWER, UPPER, Scan
from caphy.scan.scan_set import ScanSet, translated, write_scan_set, write_scans

LABELS: Final = {0: BODY, 1: BODY, 2: BODY, 3: UPPER, 4: LOWER, 5: UPPER}
"""Skin, hair, shoe, upper, lower, outer garment."""
Motion = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Pose (55, 3), translation (3,) and betas of a frame."""


def convert_take(
    take: Path, folder: Path, every: int = 1, say: Callable[[str], None] = lambda message: None
) -> ScanSet:
    """Write every ``every``-th frame of a take as a scan set; ``say`` is told of frames that had to be left out,
    and of one without SMPL-X where others have it: then there are no initial poses.

    Raises:
        CaphyError: the folder is no take, or none of its frames can be read.
    """
    meshes = sorted((take / "Meshes_pkl").glob("mesh-f*.pkl"))[::every]
    if not meshes:
        raise CaphyError(f"{take}: holds no Meshes_pkl/mesh-f*.pkl; give the folder of one take of 4D-DRESS")
    strays = {path.stem for path in folder.glob("*.ply")} - {f"f{_frame(path)}" for path in meshes}
    if strays:
        raise CaphyError(f"{folder}: holds other scans ({', '.join(sorted(strays)[:3])}); give an empty folder")
    frames: dict[str, Motion | None] = {}
    scans = _readable(take, meshes, frames, say)  # one at a time: a take may not fit into memory
    first = next(scans, None)
    if first is None:
        raise CaphyError(f"{take}: none of its {len(meshes)} frames can be read; see the messages above")
    write_scans(folder, chain([first], scans))
    bare = [name for name, motion in frames.items() if motion is None]
    if 0 < len(bare) < len(frames):
        which = f"frame {bare[0]}" + (f" and {len(bare) - 1} more" if len(bare) > 1 else "")
        say(f"note: {take}: no initial poses are written, for lack of SMPLX/mesh-fNNNNN_smplx.pkl of {which}")
    return write_scan_set(folder, [], take.name, _poses(take, list(frames.values())))


def _readable(
    take: Path, meshes: Sequence[Path], frames: dict[str, Motion | None], say: Callable[[str], None]
) -> Iterator[Scan]:
    """Scans that can be read, whose motions are added to ``frames``."""
    for path in meshes:
        try:
            scan, motion = _scan(take, path), _motion(take, path)
            _poses(path, [motion])  # raises unless it is one
        except CaphyError as error:
            say(f"left out: {error}")
            continue
        frames[scan.name] = motion
        yield scan


def _scan(take: Path, path: Path) -> Scan:
    mesh = _mapping(path, "vertices", "faces")
    vertices, faces = _array(mesh, "vertices", path), _array(mesh, "faces", path)
    label = take / "Semantic" / "labels" / f"label-f{_frame(path)}.pkl"
    labels = None
    if label.is_file():
        numbers = _array(_mapping(label, "scan_labels"), "scan_labels", label).ravel()
        if not (numbers == np.round(numbers)).all():
            raise CaphyError(f"{label}: labels must be whole numbers, got {numbers[numbers != np.round(numbers)][0]:g}")
        labels = translated(numbers.astype(np.int64), LABELS, label)
    return Scan(
        name=f"f{_frame(path)}",
        vertices=vertices.astype(np.float64),
        faces=faces.astype(np.int32),
        colours=_colours(mesh, path, len(vertices)),
        labels=labels,
        source=str(path),
    )


def _colours(mesh: Mapping[str, Any], path: Path, count: int) -> np.ndarray | None:
    atlas = path.with_name(path.name.replace("mesh-", "atlas-"))
    if atlas.is_file() and "uvs" in mesh:
        texture, uvs = np.asarray(read_pickle(atlas)), _array(mesh, "uvs", path)
        if texture.ndim != 3 or texture.shape[2] < 3 or uvs.shape != (count, 2):
            raise CaphyError(f"{atlas}: must be an image for {count} uvs, got {texture.shape} and uvs {uvs.shape}")
        if not np.isfinite(uvs).all():
            raise CaphyError(
                f"{path}: uvs must be finite, that of vertex {np.argwhere(~np.isfinite(uvs))[0, 0]} is not"
            )
        size = np.array(texture.shape[1::-1])
        column, row = (np.clip(uvs, 0, 1) * (size - 1)).round().astype(int).T
        return texture[size[1] - 1 - row, column, :3].astype(np.uint8)
    if "colors" in mesh:
        colours = _array(mesh, "colors", path)
        if colours.ndim != 2 or colours.shape[1] < 3 or len(colours) != count or not np.isfinite(colours).all():
            raise CaphyError(f"{path}: colors must be finite, of shape ({count}, 3 or 4), got {colours.shape}")
        colours = colours[:, :3]
        return (colours if colours.max(initial=0) > 1 else 255 * colours).round().astype(np.uint8)
    return None


def _motion(take: Path, path: Path) -> Motion | None:
    """Pose (55, 3), translation (3,) and betas of a frame, or none where it has no SMPL-X."""
    smplx = take / "SMPLX" / f"mesh-f{_frame(path)}_smplx.pkl"
    if not smplx.is_file():
        return None
    given = _mapping(smplx, "global_orient", "body_pose", "transl")
    pose = np.zeros((JOINT_COUNT, 3))
    places = {"global_orient": (0, 1), "body_pose": (1, 22), "jaw_pose": (22, 23), "leye_pose": (23, 24)}
    places |= {"reye_pose": (24, 25), "left_hand_pose": (25, 40), "right_hand_pose": (40, 55)}
    for name, (start, stop) in places.items():
        values = np.asarray(given[name], dtype=np.float64).ravel() if name in given else np.zeros(0)
        if len(values) == 3 * (stop - start):  # hands as principal components need the licensed model: left flat
            pose[start:stop] = values.reshape(-1, 3)
    transl, betas = _array(given, "transl", smplx), np.zeros(10)
    if transl.size != 3:
        raise CaphyError(f"{smplx}: transl must be three numbers, got shape {transl.shape}")
    own = np.asarray(given.get("betas", betas), dtype=np.float64).ravel()[:10]
    betas[: len(own)] = own
    return pose, transl.astype(np.float64).reshape(3), betas


def _poses(take: Path, frames: Sequence[Motion | None]) -> PoseSequence | None:
    known = [frame for frame in frames if frame is not None]
    if len(known) < len(frames):
        return None  # poses of some scans alone are none of a set
    poses, transl, betas = (np.stack(values) for values in zip(*known, strict=True))
    return PoseSequence(poses, transl, fps=30.0, source=str(take), betas=betas.mean(axis=0))


def _frame(path: Path) -> str:
    found = re.search(r"-f(\d+)", path.name)
    if found is None:
        raise CaphyError(f"{path}: must be named like mesh-f00011.pkl")
    return found.group(1)


def _mapping(path: Path, *names: str) -> Mapping[str, Any]:
    content = read_pickle(path)
    if not isinstance(content, Mapping) or any(name not in content for name in names):
        raise CaphyError(f"{path}: must hold {', '.join(names)}; is it of 4D-DRESS?")
    return content


def _array(content: Mapping[str, Any], name: str, path: Path) -> np.ndarray:
    values = np.asarray(content[name])
    if values.dtype.kind not in "fiu":
        raise CaphyError(f"{path}: {name} must be numbers, got {values.dtype}")
    return values
