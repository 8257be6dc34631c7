"""Measurements as pickle-free NumPy archives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final
from zipfile import is_zipfile

import numpy as np

from caphy.errors import CaphyError
from caphy.io.measurements.measurement import PLAIN, Measurement
from caphy.io.places import new_file
from caphy.io.poses.sequence import Y_UP_FROM_Z_UP, PoseSequence
from caphy.io.unpacked import require_unpackable

FORMAT: Final = "caphy-measurement-1"
ARRAYS: Final = tuple(field.name for field in fields(Measurement) if field.name not in PLAIN)
"""Keys that hold arrays."""
STEADY: Final = ("poses", "transl", "pinned_positions", "body_vertices")
"""Those that are known in every frame, also where the cloth was not seen."""
_LONGEST = 50
"""Times as many frames as were captured that a recording may have, at most."""
_OTHER = ("format", "name", "fps", "noise_mm", "up_axis", "frame_index", "frame_count", "notes")


def read_archive(path: Path) -> tuple[Measurement, bool]:
    """The measurement in an npz, and whether the file states its up axis."""
    require_unpackable(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise CaphyError(f"{path}: there is no such file") from error
    except Exception as error:
        why = "it is no npz" if "pickle" in str(error).lower() and not is_zipfile(path) else str(error)
        raise CaphyError(f"{path}: must be an npz of plain arrays, could not be read ({why})") from error
    unknown = sorted(set(arrays) - set(ARRAYS) - set(_OTHER))
    if unknown:
        raise CaphyError(f"{path}: has keys nobody reads: {', '.join(unknown)}; known: {', '.join((*ARRAYS, *_OTHER))}")
    if "fps" not in arrays:
        raise CaphyError(f"{path}: must state fps, the frames per second; it has {', '.join(sorted(arrays))}")
    return from_arrays(arrays, path.stem, str(path))


def from_arrays(arrays: Mapping[str, Any], name: str, source: str) -> tuple[Measurement, bool]:
    """A measurement with y up out of its keys, and whether they state the up axis."""
    given: dict[str, Any] = {key: arrays[key] for key in ARRAYS if key in arrays}
    if "frame_count" in arrays or "frame_index" in arrays:
        arrays = {"frame_index": np.arange(_captured(given)), **arrays}
        _spread(given, np.asarray(arrays["frame_index"]), arrays.get("frame_count"), source)
    measurement = Measurement(
        name=str(arrays.get("name", name)),
        fps=_number(arrays["fps"], "fps", source),
        noise_mm=None if "noise_mm" not in arrays else _number(arrays["noise_mm"], "noise_mm", source),
        source=source,
        numbering=(int(arrays.get("first_frame", 0)), 1),
        notes=tuple(str(note) for note in np.atleast_1d(arrays.get("notes", np.zeros(0, str)))),
        **given,
    )
    axis = str(arrays.get("up_axis", "y"))
    if axis not in ("y", "z"):
        raise CaphyError(f"{source}: up_axis must be 'y' or 'z', got {axis!r}")
    return (measurement if axis == "y" else y_up(measurement)), "up_axis" in arrays


def _captured(given: Mapping[str, Any]) -> int:
    """How many frames of cloth are there."""
    if "vertices" in given:
        return len(np.atleast_1d(given["vertices"]))
    return max(len(np.atleast_1d(given.get("offsets", ()))) - 1, 0)


def y_up(measurement: Measurement) -> Measurement:
    """A measurement whose world has z up, turned; rest shapes stay as they are."""
    turned: dict[str, Any] = {
        name: value @ Y_UP_FROM_Z_UP.T
        for name in ("vertices", "points", "body_vertices", "pinned_positions")
        if (value := getattr(measurement, name)) is not None
    }
    for prefix in ("", "preroll_"):
        poses, transl = getattr(measurement, f"{prefix}poses"), getattr(measurement, f"{prefix}transl")
        if poses is not None:
            pelvis = _pelvis(measurement) if measurement.pelvis is None else measurement.pelvis
            motion = PoseSequence(poses, transl, measurement.fps, up_axis="z", source=measurement.source).to_y_up(
                pelvis
            )
            turned |= {f"{prefix}poses": motion.poses, f"{prefix}transl": motion.transl}
    return replace(measurement, **turned)


def write_archive(measurement: Measurement, path: Path) -> None:
    """Write an npz, whole or not at all."""
    with new_file(path) as file:
        np.savez_compressed(file, allow_pickle=False, **to_arrays(measurement))


def to_arrays(measurement: Measurement) -> dict[str, Any]:
    """The keys of a measurement's npz."""
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "name": np.array(measurement.name),
        "fps": np.array(float(measurement.fps)),
        "up_axis": np.array("y"),
    }
    if measurement.noise_mm is not None:
        arrays["noise_mm"] = np.array(float(measurement.noise_mm))
    if measurement.notes:
        arrays["notes"] = np.array(measurement.notes)
    return arrays | {name: value for name in ARRAYS if (value := getattr(measurement, name)) is not None}


def _spread(given: dict[str, Any], index: np.ndarray, count: Any, source: str) -> None:
    """Put the K captured frames where they belong among all T, leaving missing frames empty."""
    whole = index.ndim == 1 and len(index) > 0 and index.dtype.kind in "iu"
    if not whole or index[0] < 0 or (np.diff(index) <= 0).any():
        countable = whole and index[0] >= 0
        place = "" if not countable else f"; at place {int(np.argmax(np.diff(index) <= 0)) + 1} it does not rise"
        raise CaphyError(f"{source}: frame_index must be rising whole numbers (K,), the captured frames' places{place}")
    steady = [len(given[k]) for k in STEADY if k in given]
    total = max([int(index[-1]) + 1, *steady])
    if count is not None:
        stated = _number(count, "frame_count", source)
        if not stated.is_integer():
            raise CaphyError(f"{source}: frame_count must be a whole number, got {stated:g}")
        total = int(stated)
    if total > _LONGEST * len(index):
        raise CaphyError(
            f"{source}: {len(index)} frames were captured of {total}; are frame_index, or the numbers in files' names, "
            "times? Number frames, one after another at fps, or cut what was not seen"
        )
    if index[-1] >= total:
        raise CaphyError(f"{source}: frame_index reaches {index[-1]}, but there are {total} frames")
    for name in ("vertices", "visibility", "noise"):
        value = np.asarray(given[name]) if name in given else None
        if value is None or (name == "noise" and value.ndim != 2):
            continue
        if len(value) != len(index):
            raise CaphyError(f"{source}: {name} must have the {len(index)} frames of frame_index, got {len(value)}")
        full = np.zeros((total, *value.shape[1:]), value.dtype)
        if value.dtype.kind == "f" and name != "visibility":
            full[:] = np.nan
        full[index] = value
        given[name] = full
    if "offsets" in given:
        counts = np.zeros(total, dtype=np.int64)
        sizes = np.diff(np.asarray(given["offsets"]))
        if len(sizes) != len(index):
            raise CaphyError(f"{source}: offsets must have {len(index) + 1} entries, got {len(sizes) + 1}")
        counts[index] = sizes
        given["offsets"] = np.concatenate([[0], np.cumsum(counts)])


def _number(value: Any, name: str, source: str) -> float:
    given = np.asarray(value)
    if given.size != 1 or given.dtype == bool:
        what = f"an array of shape {given.shape}" if given.size != 1 else repr(value)
        raise CaphyError(f"{source}: {name} must be one number, got {what}")
    try:
        return float(given.reshape(()))
    except (TypeError, ValueError) as error:
        raise CaphyError(f"{source}: {name} must be one number, got {value!r}") from error


def _pelvis(measurement: Measurement) -> np.ndarray:
    from caphy.body.bundled import default_body

    return default_body().rest(measurement.betas)[1][0]
