"""Measurements as folders: one PLY or OBJ per frame and a TOML that says what they are."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
import tomllib
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io.measurements.archive import ARRAYS, from_arrays, to_arrays
from caphy.io.measurements.measurement import Measurement

DESCRIPTION: Final = "measurement.toml"
EXTRA: Final = "arrays.npz"
REST: Final = "rest.ply"
"""The rest mesh, where the description names no other."""
_KEYS = ("fps", "name", "frames", "registered", "rest", "poses", "arrays", "up_axis", "noise_mm", "frame_count")


def read_folder(folder: Path) -> tuple[Measurement, bool]:
    """The measurement in a folder with a ``measurement.toml``, and whether it states its up axis."""
    description = _description(folder)
    if "rest" not in description and (folder / REST).is_file():
        description["rest"] = REST
    arrays: dict[str, Any] = _extra(folder, description)
    where = folder / DESCRIPTION
    if "rest" in description:
        rest, faces = _mesh(folder / description["rest"])
        arrays |= {"rest_vertices": rest, "faces": faces}
    if "poses" in description:
        arrays |= _motion(folder / description["poses"], float(description["fps"]))
    files = _frames(folder, description)
    meshes = {frame: _mesh(path) for frame, path in files.items()}
    registered = bool(description.get("registered", "rest" in description))
    arrays |= _registered(meshes, files, arrays, where) if registered else _clouds(meshes)
    first = min(files)
    arrays["frame_index"] = np.array(sorted(files)) - first
    arrays |= {
        key: description[key] for key in ("fps", "name", "up_axis", "noise_mm", "frame_count") if key in description
    }
    return from_arrays(arrays, folder.name, str(folder))


def write_folder(measurement: Measurement, folder: Path) -> None:
    """Write a folder; a reader sees it whole or not at all."""
    if folder.exists() and not (folder / DESCRIPTION).is_file():
        raise CaphyError(f"{folder}: exists and is no measurement; choose another name")
    partial = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        _fill(measurement, partial)
        partial.chmod(0o755)
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _fill(measurement: Measurement, folder: Path) -> None:
    arrays = to_arrays(measurement)
    faces = arrays.pop("faces", np.zeros((0, 3), np.int64))
    lines = {"fps": float(measurement.fps), "name": measurement.name, "up_axis": "y"}
    lines |= {"registered": measurement.registered, "frame_count": len(measurement)}
    if "noise_mm" in arrays:
        lines["noise_mm"] = float(arrays.pop("noise_mm"))
    rest = arrays.pop("rest_vertices", None)
    if rest is not None:
        _write_ply(folder / REST, rest, faces)
        lines["rest"] = REST
    elif len(faces):
        arrays["faces"] = faces
    for frame in range(len(measurement)):
        if measurement.vertices is not None:
            # Frames without a single vertex are written too, so that the first file is always frame 0.
            _write_ply(folder / f"frame_{frame:05d}.ply", measurement.vertices[frame], faces)
        else:
            _write_ply(folder / f"frame_{frame:05d}.ply", measurement.cloud(frame), faces[:0])
    extra = {
        key: value for key, value in arrays.items() if key in ARRAYS and key not in ("vertices", "points", "offsets")
    }
    if extra:
        np.savez_compressed(folder / EXTRA, allow_pickle=False, **extra)
        lines["arrays"] = EXTRA
    text = "".join(f"{key} = {json.dumps(value)}\n" for key, value in lines.items())
    (folder / DESCRIPTION).write_text(text, encoding="utf-8")


def _description(folder: Path) -> dict[str, Any]:
    path = folder / DESCRIPTION
    try:
        description = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CaphyError(f"{folder}: a measurement's folder needs a {DESCRIPTION} with at least: fps = 30") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise CaphyError(f"{path}: cannot be read: {error}") from error
    unknown = sorted(set(description) - set(_KEYS))
    if unknown:
        raise CaphyError(f"{path}: has keys nobody reads: {', '.join(unknown)}; known: {', '.join(_KEYS)}")
    if not isinstance(description.get("fps"), (int, float)):
        raise CaphyError(f"{path}: must state the frames per second, such as: fps = 30")
    return description


def _extra(folder: Path, description: dict[str, Any]) -> dict[str, Any]:
    if "arrays" not in description:
        return {}
    path = folder / description["arrays"]
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files if name in ARRAYS}
    except Exception as error:
        raise CaphyError(f"{path}: must be an npz of plain arrays, could not be read ({error})") from error


def _motion(path: Path, fps: float) -> dict[str, Any]:
    from caphy.io.poses import read_poses

    motion = read_poses(path)
    if abs(motion.fps - fps) > 1e-6:
        motion = motion.resample(fps)
    given: dict[str, Any] = {"poses": motion.poses, "transl": motion.transl}
    return given if motion.betas is None else given | {"betas": motion.betas}


def _frames(folder: Path, description: dict[str, Any]) -> dict[int, Path]:
    """Files by the last number in their names, which is their frame."""
    pattern = description.get("frames")
    paths = sorted(folder.glob(pattern)) if pattern else sorted([*folder.glob("*.ply"), *folder.glob("*.obj")])
    files: dict[int, Path] = {}
    for path in paths:
        numbers = re.findall(r"\d+", path.stem)
        if path.name == description.get("rest") or not numbers:
            continue
        frame = int(numbers[-1])
        if frame in files:
            raise CaphyError(f"{folder}: {files[frame].name} and {path.name} are both frame {frame}")
        files[frame] = path
    if not files:
        raise CaphyError(f"{folder}: needs one .ply or .obj per frame with the frame's number in its name, got none")
    return dict(sorted(files.items()))


def _mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) of a file, in its own order."""
    import trimesh

    try:
        loaded: Any = trimesh.load(path, process=False, maintain_order=True)
        if isinstance(loaded, trimesh.Scene) and loaded.geometry:
            raise ValueError(f"it holds {len(loaded.geometry)} objects; a frame is one mesh")
        vertices = np.asarray(getattr(loaded, "vertices", np.zeros((0, 3))), dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(getattr(loaded, "faces", np.zeros((0, 3))), dtype=np.int64).reshape(-1, 3)
    except Exception as error:
        raise CaphyError(f"{path}: cannot be read as a mesh or cloud: {type(error).__name__}: {error}") from error
    return vertices, faces


def _registered(
    meshes: dict[int, tuple[np.ndarray, np.ndarray]], files: dict[int, Path], arrays: dict[str, Any], where: Path
) -> dict[str, Any]:
    first, (vertices, faces) = next(iter(meshes.items()))
    count = len(arrays.get("rest_vertices", vertices))
    for frame, (points, _) in meshes.items():
        if len(points) != count:
            other = "the rest mesh" if "rest_vertices" in arrays else files[first].name
            raise CaphyError(
                f"{files[frame]}: has {len(points)} vertices, {other} {count}; a registered cloth keeps its mesh. "
                f"For scans set registered = false in {where.name}"
            )
    given: dict[str, Any] = {"vertices": np.stack([points for points, _ in meshes.values()])}
    return given if "faces" in arrays else given | {"faces": faces}


def _clouds(meshes: dict[int, tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    clouds = [points[np.isfinite(points).all(axis=1)] for points, _ in meshes.values()]
    return {"points": np.concatenate(clouds), "offsets": np.concatenate([[0], np.cumsum([len(c) for c in clouds])])}


def _write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """A binary PLY with float64 vertices, so that nothing is lost."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    path.write_bytes(header.encode() + np.asarray(vertices, "<f8").tobytes() + rows.tobytes())
