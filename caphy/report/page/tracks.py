"""Moving meshes and their errors packed for the viewer: quantised, compressed, bounded in size."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BUDGET = 12_000_000
"""Most bytes of raw numbers that one scene may hold; longer motions are thinned out in time."""
CLOUD = 5000
"""Most points of a cloud that are shown in a frame."""
STEP_MM = 0.01
"""Resolution of packed errors [mm], unless they reach so far that 16 bits need a coarser one."""
HOLE = -32768
"""Packed error where nothing was measured."""
AZIMUTH, ELEVATION, FIELD = 0.6, 0.22, 0.62
"""From where the viewer looks at first, and how much it sees from top to bottom [rad]."""
MARGIN = 1.05
"""Times the distance from which all is just seen."""


@dataclass(frozen=True, eq=False)
class Track:
    """What the viewer shows of one comparison; rows are frames.

    vertices: the model's (N, V, 3) [m]. faces: (F, 3). measured: registered positions (N, V, 3) with NaN in holes, or
    a list of N clouds (n, 3), or none. fields: name -> errors (N, V) [mm], NaN where unknown. frames: (N,).
    body: (N, B, 3), with body_faces, or none. numbering: frame 0's number in the source, and from it to the next one's.
    moments: rows that are shown however many are left out.
    """

    vertices: np.ndarray
    faces: np.ndarray
    frames: np.ndarray
    fps: float
    fields: dict[str, np.ndarray]
    measured: np.ndarray | list[np.ndarray] | None = None
    body: np.ndarray | None = None
    body_faces: np.ndarray | None = None
    regions: np.ndarray | None = None
    numbering: tuple[int, int] = (0, 1)
    moments: Sequence[int] = ()


def pack(track: Track) -> dict:
    """A JSON-ready scene for ``viewer.js``: base64 of gzip of little-endian numbers, and how to read them."""
    shown = _shown(track)
    rows = _kept_rows(track, shown)
    vertices = track.vertices[rows]
    measured = None if shown is None else [shown[int(r)] for r in rows]
    body = None if track.body is None else track.body[rows]
    clouds = [vertices.reshape(-1, 3), *(measured or [])] + ([] if body is None else [body.reshape(-1, 3)])
    points = np.concatenate([c.reshape(-1, 3) for c in clouds])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    scale = float(max((high - low).max(), 1e-6) / 65534)
    names, region = np.unique(["" if track.regions is None else r for r in _regions(track)], return_inverse=True)
    fields = {name: values[rows] for name, values in track.fields.items()}
    step = max(STEP_MM, *(float(np.nanmax(np.abs(each), initial=0.0)) / 32767 for each in fields.values()), STEP_MM)
    scene = {
        "fps": track.fps,
        "numbering": [int(each) for each in track.numbering],
        "rows": len(rows),
        "leftOut": _left_out(track, len(rows)),
        "frames": track.frames[rows].tolist(),
        "vertexCount": vertices.shape[1],
        "low": low.tolist(),
        "scale": scale,
        "focus": _focus(vertices, body),
        "faces": _encode(track.faces.astype("<u4")),
        "model": _encode(_quantised(vertices, low, scale)),
        "fields": {name: _encode(_errors(values, step)) for name, values in fields.items()},
        "stepMm": step,
        "regionNames": names.tolist(),
        "regions": _encode(region.astype("<u2")),
    }
    if measured is not None:
        scene["measured"] = _encode(np.concatenate([_quantised(c, low, scale).reshape(-1, 3) for c in measured]))
        scene["measuredOffsets"] = np.concatenate([[0], np.cumsum([len(c) for c in measured])]).tolist()
        scene["measuredMesh"] = isinstance(track.measured, np.ndarray)
    if body is not None and track.body_faces is not None:
        scene |= {"body": _encode(_quantised(body, low, scale)), "bodyCount": body.shape[1]}
        scene["bodyFaces"] = _encode(track.body_faces.astype("<u4"))
    return scene


def _focus(vertices: np.ndarray, body: np.ndarray | None) -> dict:
    """The camera at first: it sees the whole motion of cloth on pins, or a body, which it follows, in every frame.

    centre [m], distance [m], and azimuth, elevation and field of view from top to bottom [rad].
    """
    seen = vertices.reshape(1, -1, 3) if body is None else body
    centre = 0.5 * (seen[0].min(axis=0) + seen[0].max(axis=0))
    around = seen - seen.mean(axis=1, keepdims=True) + (seen[0].mean(axis=0) - centre)
    (sin_a, sin_e), (cos_a, cos_e) = np.sin([AZIMUTH, ELEVATION]), np.cos([AZIMUTH, ELEVATION])
    towards, right = np.array([sin_a * cos_e, sin_e, cos_a * cos_e]), np.array([cos_a, 0.0, -sin_a])
    aside = np.maximum(np.abs(around @ right), np.abs(around @ np.cross(towards, right)))
    distance = MARGIN * float((around @ towards + aside / np.tan(FIELD / 2)).max())
    return {
        "centre": centre.tolist(),
        "distance": distance,
        "azimuth": AZIMUTH,
        "elevation": ELEVATION,
        "field": FIELD,
    }


def _regions(track: Track) -> np.ndarray:
    return np.full(track.vertices.shape[1], "") if track.regions is None else track.regions


def _shown(track: Track) -> np.ndarray | list[np.ndarray] | None:
    """What was measured, of clouds no more than :data:`CLOUD` points each, evenly picked."""
    if not isinstance(track.measured, list):
        return track.measured
    return [c if len(c) <= CLOUD else c[np.linspace(0, len(c) - 1, CLOUD).astype(int)] for c in track.measured]


def _left_out(track: Track, rows: int) -> str:
    """What the viewer does not show, in words; nothing where it shows all."""
    parts = []
    if rows < len(track.vertices):
        parts.append(
            f"{rows} of the {len(track.vertices)} frames compared (figures are of all), with the worst moments"
        )
    if isinstance(track.measured, list) and (most := max(map(len, track.measured), default=0)) > CLOUD:
        parts.append(f"{CLOUD} of the up to {most} points of a frame")
    return f"To keep this page small the view holds {' and '.join(parts)}." if parts else ""


def _kept_rows(track: Track, shown: np.ndarray | list[np.ndarray] | None) -> np.ndarray:
    """All rows, or every second, third, ... and the worst moments, where all would not fit the budget."""
    count = len(track.vertices)
    per_row = track.vertices.shape[1] * (6 + 2 * len(track.fields))
    per_row += 0 if track.body is None else track.body.shape[1] * 6
    if shown is not None:
        per_row += int(6 * np.mean([len(c) for c in shown]))
    stride = max(int(np.ceil(per_row * count / BUDGET)), 1)
    return np.union1d(np.arange(0, count, stride), np.asarray(track.moments, int))


def _quantised(points: np.ndarray, low: np.ndarray, scale: float) -> np.ndarray:
    """Unsigned 16-bit positions; 65535 in holes."""
    values = np.nan_to_num(np.rint((points - low) / scale), nan=65535)
    return values.astype("<u2")


def _errors(values: np.ndarray, step: float) -> np.ndarray:
    """Signed 16-bit errors in steps of so many millimetres."""
    steps = np.clip(np.nan_to_num(values / step), -32767, 32767)
    return np.where(np.isfinite(values), np.rint(steps), HOLE).astype("<i2")


def _encode(values: np.ndarray) -> str:
    return base64.b64encode(gzip.compress(np.ascontiguousarray(values).tobytes(), 6, mtime=0)).decode("ascii")
