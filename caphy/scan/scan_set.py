"""A folder of scans and a TOML that says what they are; each scan is read when it is asked for."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io.places import write_bytes, write_text
from caphy.io.poses import PoseSequence, read_poses
from caphy.scan.mesh_files import SUFFIXES, MeshFile, read_mesh_file, write_ply
from caphy.scan.scan import LABEL_NAMES, UNKNOWN, Scan

DESCRIPTION: Final = "scans.toml"
UNITS: Final = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
"""Metres per unit."""
MOST_LABELS: Final = 65535
"""Largest number of a label that :data:`DESCRIPTION` may give a meaning."""

_UP: Final[dict[str, list[list[int]]]] = {
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}
"""Rotations that turn each axis upward; none mirrors."""

_KEYS: Final = ("name", "unit", "up_axis", "scans", "poses", "labels", "label_numbers")


@dataclass(frozen=True, eq=False)
class ScanSet:
    """The scans of one person. ``scans[i]`` reads one file; iterating reads them one after another."""

    name: str
    folder: Path
    files: tuple[Path, ...]
    """One mesh per scan, sorted by the scans' names."""
    scale: float
    """Metres per unit of the files."""
    rotation: np.ndarray
    """(3, 3): turns the files' axes into ours, y up."""
    poses: PoseSequence | None = None
    """Initial poses, one frame per scan, y up; ``poses.pelvis`` says which rest pelvis ``transl`` refers to."""
    labels: Path | None = None
    """Folder of ``NAME.npy`` with one number per vertex, or none."""
    label_numbers: Mapping[int, int] | None = None
    """What the labels' numbers mean, to :data:`caphy.scan.scan.LABEL_NAMES`; none if they are ours already."""
    poses_file: Path | None = None
    """Where the poses were read."""
    labels_alone: bool = False
    """Whether a scan without labels there has none, whatever its mesh carries."""

    @classmethod
    def read(cls, folder: str | Path, labels: Path | None = None) -> ScanSet:
        """The set in a folder with a ``scans.toml``; ``labels`` is a folder of them to use instead of its own.

        A scan that has none there has none: 'caphy fit' leaves out scans so.

        Raises:
            CaphyError: the description is missing, damaged or says something unknown, or there are no scans.
        """
        folder = Path(folder)
        given = _description(folder)
        files = _files(folder, given.get("scans"))
        own = folder / given.get("labels", "labels")
        for place, told in ((labels, labels is not None), (own, "labels" in given)):
            if told and place is not None and not place.is_dir():
                raise CaphyError(f"{place}: there is no such folder of labels; 'caphy segment' makes them")
        return cls(
            name=str(given.get("name", folder.name)),
            folder=folder,
            files=files,
            scale=UNITS[given["unit"]],
            rotation=np.array(_UP[given["up_axis"]], dtype=np.float64),
            poses=_poses(folder, given, files),
            poses_file=folder / given["poses"] if "poses" in given else None,
            labels=labels or (own if own.is_dir() else None),
            label_numbers=None if labels else _numbers(folder, given.get("label_numbers")),
            labels_alone=labels is not None,
        )

    def without_labels(self) -> ScanSet:
        """The same set, of whose own labels nobody asks, those in its meshes included."""
        return replace(self, labels=None, labels_alone=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the scans: their files' without suffix."""
        return tuple(path.stem for path in self.files)

    @property
    def beyond(self) -> tuple[Path, ...]:
        """What of it lies elsewhere than in its folder: scans, folder of labels, file of poses."""
        parts = [path for path in (*self.files, self.labels, self.poses_file) if path is not None]
        return tuple(path for path in parts if not path.resolve().is_relative_to(self.folder.resolve()))

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[Scan]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Scan:
        """Scan number ``index``; raises :class:`CaphyError` naming the file, after which others can still be read."""
        path = self.files[index]
        mesh = read_mesh_file(path)
        return Scan(
            name=path.stem,
            vertices=self.scale * mesh.vertices @ self.rotation.T,
            faces=mesh.faces,
            colours=mesh.colours,
            labels=self._labels(path, mesh),
            pose=None if self.poses is None else self.poses.poses[index],
            transl=None if self.poses is None else self.poses.transl[index],
            source=str(path),
            pelvis=None if self.poses is None else self.poses.transl[index] + self.poses.pelvis,
        )

    def _labels(self, path: Path, mesh: MeshFile) -> np.ndarray | None:
        beside = None if self.labels is None else self.labels / f"{path.stem}.npy"
        numbers, where = None if self.labels_alone else mesh.label, path
        if beside is not None and beside.is_file():
            numbers, where = read_labels(beside), beside
        if numbers is None:
            return None
        if len(numbers) != len(mesh.vertices):
            raise CaphyError(
                f"{where}: has {len(numbers)} labels for the {len(mesh.vertices)} vertices of {path.name}; they must "
                "be in the order of that file's vertices"
            )
        return translated(numbers, self.label_numbers, where, not self.labels_alone)


def read_labels(path: Path) -> np.ndarray:
    """The integers (V,) in a ``.npy`` file, never unpickling."""
    try:
        labels = np.load(path, allow_pickle=False)
        if labels.ndim != 1 or labels.dtype.kind not in "iu":
            raise ValueError(f"it holds {labels.dtype} of shape {labels.shape}")
    except (OSError, ValueError, EOFError) as error:
        raise CaphyError(f"{path}: must hold one whole number per vertex: {error}") from error
    return labels


def write_labels(path: Path, labels: np.ndarray) -> None:
    """Write labels (V,) as a ``.npy`` of uint8, whole or not at all."""
    stream = BytesIO()
    np.save(stream, np.asarray(labels, dtype=np.uint8), allow_pickle=False)
    write_bytes(path, stream.getvalue())


def translated(numbers: np.ndarray, meaning: Mapping[int, int] | None, where: Path, own: bool = True) -> np.ndarray:
    """Labels (V,) uint8 of a file's own numbers (V,), of which scans.toml may tell the meaning."""
    known = {**{i: i for i in range(len(LABEL_NAMES))}, UNKNOWN: UNKNOWN} if meaning is None else meaning
    strange = sorted(set(np.unique(numbers).tolist()) - set(known))
    if strange:
        raise CaphyError(
            f"{where}: labels must be {', '.join(f'{i} {name}' for i, name in enumerate(LABEL_NAMES))} or {UNKNOWN} "
            f"unknown, got {strange[0]}; "
            + (
                f"say in {DESCRIPTION} what your numbers mean: "
                "label_numbers = {body = [0, 1, 2], upper = [3], lower = [4]}"
                if own
                else f"what {DESCRIPTION} says of numbers goes for the set's own labels, not for those of --labels"
            )
        )
    table = np.full(max(known) + 1, UNKNOWN, dtype=np.uint8)
    table[list(known)] = list(known.values())
    return table[numbers]


def write_scan_set(folder: Path, scans: Iterable[Scan], name: str, poses: PoseSequence | None = None) -> ScanSet:
    """Write scans as a set in metres with y up: PLY files with colours and labels, ``scans.toml``, ``poses.npz``."""
    from caphy.io.poses.canonical import write_poses

    write_scans(folder, scans)
    lines = {"name": name, "unit": "m", "up_axis": "y", "scans": "*.ply"}
    if poses is not None:
        write_poses(poses, folder / "poses.npz")
        lines["poses"] = "poses.npz"
    text = "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in lines.items())
    write_text(folder / DESCRIPTION, text)
    return ScanSet.read(folder)


def write_scans(folder: Path, scans: Iterable[Scan]) -> None:
    """Write the scans of a set without its description, in metres with y up."""
    folder.mkdir(parents=True, exist_ok=True)
    for scan in scans:
        write_ply(folder / f"{scan.name}.ply", MeshFile(scan.vertices, scan.faces, scan.colours, scan.labels))


def _description(folder: Path) -> dict[str, Any]:
    path = folder / DESCRIPTION
    example = 'unit = "mm" and up_axis = "z"'
    try:
        given = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise CaphyError(f"{folder}: a folder of scans needs a {DESCRIPTION} with, for example: {example}") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise CaphyError(f"{path}: cannot be read: {error}") from error
    unknown = sorted(set(given) - set(_KEYS))
    if unknown:
        raise CaphyError(f"{path}: has keys nobody reads: {', '.join(unknown)}; known: {', '.join(_KEYS)}")
    for key, choices in (("unit", UNITS), ("up_axis", _UP)):
        if not isinstance(given.get(key), str) or given[key] not in choices:
            raise CaphyError(
                f"{path}: {key} must be one of {', '.join(choices)}, got {given.get(key)!r}; for example: {example}"
            )
    for key in ("name", "scans", "poses", "labels"):
        if key in given and not isinstance(given[key], str):
            raise CaphyError(f"{path}: {key} must be text, got {given[key]!r}")
    return given


def _files(folder: Path, pattern: str | None) -> tuple[Path, ...]:
    try:
        found = folder.glob(pattern) if pattern else (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
        seen = (p for p in found if p.is_file() and not p.name.startswith("."))  # as a Mac leaves beside each file
        files = tuple(sorted(seen, key=lambda p: p.stem))  # as poses are, whatever folders
    except (ValueError, NotImplementedError) as error:
        raise CaphyError(f"{folder / DESCRIPTION}: scans must be a pattern such as '*.ply': {error}") from error
    if not files:
        raise CaphyError(f"{folder}: holds no scans ({pattern or ', '.join(SUFFIXES)})")
    stems = [path.stem for path in files]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise CaphyError(f"{folder}: several scans are named {twice}; give each its own name")
    return files


def _poses(folder: Path, given: dict[str, Any], files: tuple[Path, ...]) -> PoseSequence | None:
    if "poses" not in given:
        return None
    poses = read_poses(folder / given["poses"])
    if len(poses) != len(files):
        raise CaphyError(
            f"{folder / given['poses']}: holds {len(poses)} poses for {len(files)} scans; there must be one frame per "
            "scan, in the order of their names"
        )
    return poses


def _numbers(folder: Path, given: Any) -> dict[int, int] | None:
    if given is None:
        return None
    try:
        found = {int(number): LABEL_NAMES.index(name) for name, numbers in given.items() for number in numbers}
        if not all(0 <= number <= MOST_LABELS for number in found):
            raise ValueError("a number is out of range")
    except (AttributeError, TypeError, ValueError) as error:
        raise CaphyError(
            f"{folder / DESCRIPTION}: label_numbers must name {', '.join(LABEL_NAMES)} with lists of numbers from 0 to "
            f"{MOST_LABELS}, such as label_numbers = {{body = [0, 1, 2], upper = [3], lower = [4]}}"
        ) from error
    return {UNKNOWN: UNKNOWN} | found
