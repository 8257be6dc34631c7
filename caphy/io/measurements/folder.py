"""Measurements as folders: one PLY or OBJ per frame and a TOML that says what they are."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io.measurements.archive import ARRAYS, STEADY, from_arrays, to_arrays
from caphy.io.measurements.checks import mesh_edges
from caphy.io.measurements.measurement import Measurement
from caphy.io.places import new_folder
from caphy.io.unpacked import require_unpackable

DESCRIPTION: Final = "measurement.toml"
EXTRA: Final = "arrays.npz"
REST: Final = "rest.ply"
"""The rest mesh, where the description names no other."""
_TEXT, _NUMBERS, _WHOLE = "text", "a number", "a whole number"
_KEYS: Final = {
    "fps": _NUMBERS,
    "name": _TEXT,
    "frames": _TEXT,
    "registered": "true or false",
    "rest": _TEXT,
    "poses": _TEXT,
    "arrays": _TEXT,
    "up_axis": _TEXT,
    "noise_mm": _NUMBERS,
    "first_frame": _WHOLE,
    "frame_count": _WHOLE,
}
"""What the description may state, and as what."""
_ALIKE = 0.5
"""Share of a mesh's edges that a frame's mesh must have: quads may be cut along either diagonal."""


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
        arrays |= _motion(folder / description["poses"], float(description["fps"]), description.get("up_axis") == "z")
    files = _frames(folder, description)
    meshes = {frame: _mesh(path) for frame, path in files.items()}
    registered = bool(description.get("registered", "rest" in description))
    arrays |= _registered(meshes, files, arrays, where) if registered else _clouds(meshes)
    arrays["first_frame"] = _first_frame(files, arrays, description, where)
    arrays["frame_index"] = np.array(sorted(files)) - arrays["first_frame"]
    arrays |= {
        key: description[key] for key in ("fps", "name", "up_axis", "noise_mm", "frame_count") if key in description
    }
    return from_arrays(arrays, folder.name, str(folder))


def _first_frame(files: dict[int, Path], arrays: dict[str, Any], description: dict[str, Any], where: Path) -> int:
    """The number that frame 0 has in files' names: the smallest, unless others than files' frames speak against it."""
    first, last = min(files), max(files)
    if "first_frame" in description:
        if not 0 <= description["first_frame"] <= first:
            raise CaphyError(
                f"{where}: first_frame is the number of the first frame in files' names, at most {first}, the smallest "
                f"of them; got {description['first_frame']}"
            )
        return description["first_frame"]
    counts = {name: len(arrays[name]) for name in STEADY if name in arrays}
    if "frame_count" in description:
        counts["frame_count"] = description["frame_count"]
    other = next((name for name, count in counts.items() if first and count != last - first + 1), None)
    if other is not None:
        raise CaphyError(
            f"{where}: files are numbered from {first} to {last}, and {other} has {counts[other]} frames: which of "
            f"them are these? State first_frame = {first} if the first file is of the first of them, first_frame = 0 "
            "if numbers count from 0 and frames before it were not seen"
        )
    return first


def write_folder(measurement: Measurement, folder: Path) -> None:
    """Write a folder; a reader sees it whole or not at all. What stood there is removed once the new one is there."""
    if folder.exists() and not (folder / DESCRIPTION).is_file():
        raise CaphyError(f"{folder}: exists and is no measurement; choose another name")
    with new_folder(folder) as partial:
        _fill(measurement, partial)


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
        description = tomllib.loads(path.read_text(encoding="utf-8-sig"))  # as editors of Windows write it
    except FileNotFoundError as error:
        raise CaphyError(f"{folder}: a measurement's folder needs a {DESCRIPTION} with at least: fps = 30") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise CaphyError(f"{path}: cannot be read: {error}") from error
    unknown = sorted(set(description) - set(_KEYS))
    if unknown:
        raise CaphyError(f"{path}: has keys nobody reads: {', '.join(unknown)}; known: {', '.join(_KEYS)}")
    if "fps" not in description:
        raise CaphyError(f"{path}: must state the frames per second, such as: fps = 30")
    for name, value in description.items():
        if not _is(value, _KEYS[name]):
            raise CaphyError(f"{path}: {name} must be {_KEYS[name]}, got {value!r}")
    return description


def _is(value: Any, what: str) -> bool:
    if what == _TEXT:
        return isinstance(value, str) and value != ""
    if isinstance(value, bool) or what == _KEYS["registered"]:
        return isinstance(value, bool) and what == _KEYS["registered"]
    return isinstance(value, int) or (what == _NUMBERS and isinstance(value, float))


def _extra(folder: Path, description: dict[str, Any]) -> dict[str, Any]:
    if "arrays" not in description:
        return {}
    path = folder / description["arrays"]
    require_unpackable(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:
        raise CaphyError(f"{path}: must be an npz of plain arrays, could not be read ({error})") from error
    told = {"vertices", "points", "offsets", "frame_index"}
    told |= {"rest_vertices", "faces"} if "rest" in description else set()
    told |= {"poses", "transl", "pelvis"} if "poses" in description else set()
    if doubled := sorted(set(arrays) & told):
        raise CaphyError(
            f"{path}: has {', '.join(doubled)}, which other files of the folder tell: each frame's PLY or OBJ by its "
            "number, the rest mesh and the poses; give one of both, or the npz itself as the measurement"
        )
    if foreign := sorted(set(arrays) - set(ARRAYS)):
        raise CaphyError(
            f"{path}: has keys that nobody reads here: {', '.join(foreign)}; it may hold {', '.join(ARRAYS)}; "
            f"{', '.join(_KEYS)} belong in {DESCRIPTION}"
        )
    return arrays


def _motion(path: Path, fps: float, z_up: bool) -> dict[str, Any]:
    """The motion in a file, which says what its axes are, with the cloth's axis up."""
    from caphy.io.poses import read_poses

    motion = read_poses(path)
    if abs(motion.fps - fps) > 1e-6:
        motion = motion.resample(fps)
    motion = motion.to_z_up() if z_up else motion
    given: dict[str, Any] = {"poses": motion.poses, "transl": motion.transl, "pelvis": motion.pelvis}
    return given if motion.betas is None else given | {"betas": motion.betas}


def _frames(folder: Path, description: dict[str, Any]) -> dict[int, Path]:
    """Files by the last number in their names, which is their frame."""
    pattern = description.get("frames")
    try:
        paths = sorted(folder.glob(pattern or "*"))
    except (NotImplementedError, ValueError) as error:
        raise CaphyError(
            f"{folder / DESCRIPTION}: frames must be a pattern of names within the folder, such as 'frame_*.ply', got "
            f"{pattern!r}"
        ) from error
    if not pattern:
        paths = [path for path in paths if path.suffix.lower() in (".ply", ".obj")]
    files: dict[int, Path] = {}
    rest = (folder / description["rest"]).resolve() if "rest" in description else None
    for path in paths:
        numbers = re.findall(r"\d+", path.stem)
        if path.resolve() == rest or not numbers:
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
    same = arrays.get("faces", faces)
    known = _edges(same)
    for frame, (_, own) in meshes.items():
        if np.array_equal(own, same) or not len(own):
            continue
        if len(known & _edges(own)) < _ALIKE * len(known):
            other = "the rest mesh" if "faces" in arrays else files[first].name
            raise CaphyError(
                f"{files[frame]}: its triangles are not those of {other}, so that its vertices are in another order; a "
                f"registered cloth keeps its mesh. For scans set registered = false in {where.name}"
            )
    given: dict[str, Any] = {"vertices": np.stack([points for points, _ in meshes.values()])}
    return given if "faces" in arrays else given | {"faces": faces}


def _edges(faces: np.ndarray) -> set[tuple[int, int]]:
    return set(map(tuple, mesh_edges(faces).tolist()))


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
