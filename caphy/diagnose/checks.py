"""Is this a measurement of this cloth at all? Wrong units, shuffled frames and foreign meshes must not get a name."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.garment.topology import edges
from caphy.io.measurements import Measurement
from caphy.measure.noise import measurement_noise
from caphy.measure.scene import Scene

_SIZE = (0.6, 1.6)  # median length of an edge over its rest length
_SPREAD = 2.5  # ratio of the 90th to the 10th percentile of the same
_SAME = 1.1  # ratio of edges at rest up to which two measurements may be of one cloth
_SHARED = 0.25  # of the frames of the shorter: films without noise may begin alike, but no more than that
_STILL = 6.0  # standard deviations of the noise that cloth must move in two frames to tell their order
_TURNS = 0.85  # step to the next frame over step to the one after: 0.5 on a straight path, 1 for shuffled frames


def check_cloth(scene: Scene) -> None:
    """Raises :class:`CaphyError` where a registered measurement cannot be of the scene's cloth in steady motion."""
    if not scene.measurement.registered:
        return
    vertices = scene.measurement.seen_vertices
    where = scene.measurement.source or scene.measurement.name
    _check_edges(vertices, scene, where)
    _check_order(vertices, scene, where)


def require_one_cloth(**parts: Sequence[Measurement]) -> None:
    """Raises :class:`CaphyError` where measurements are of several cloths, or one of them is in two parts.

    ``parts`` are named as people call them, the first of them being what is diagnosed.
    """
    named = [(part.replace("_", "-"), measurement) for part, them in parts.items() for measurement in them]
    of: dict[str, Any] = {"faces": None}
    frames = [_frames(measurement) for _, measurement in named]
    for number, (part, measurement) in enumerate(named):
        where = measurement.source or measurement.name
        for (other, before), known in zip(named[:number], frames, strict=False):
            shared = len(frames[number] & known)
            if shared < _SHARED * min(len(frames[number]), len(known)):
                continue
            same = "the same frames as" if shared == len(frames[number]) == len(known) else f"{shared} of the frames of"
            if other == part:
                raise CaphyError(
                    f"{where}: holds {same} {before.source or before.name}; one motion given twice is not twice the "
                    "evidence: give it once"
                )
            raise CaphyError(
                f"{where}: holds {same} {before.source or before.name}, one as the {part} and one as the {other} "
                f"measurement; what was learned or fitted there proves nothing here: give another motion"
            )
        if measurement.rest_vertices is None or measurement.faces is None:
            continue
        lengths = _lengths(measurement.rest_vertices, measurement.faces)
        if of["faces"] is None:
            of = {"faces": measurement.faces, "lengths": lengths, "where": where}
            continue
        if not np.array_equal(of["faces"], measurement.faces):
            raise CaphyError(f"{where}: must be of the cloth of {of['where']}, but has other faces")
        ratio = lengths / of["lengths"]
        low, high = np.quantile(ratio, (0.1, 0.9))
        if not 1 / _SAME < low <= high < _SAME:
            raise CaphyError(
                f"{where}: must be of the cloth of {of['where']}, but its edges at rest are {low:.2g} to {high:.2g} "
                "times as long"
            )


def _frames(measurement: Measurement) -> set[bytes]:
    """What was seen in each frame; frames of cloth that is perfectly still count once."""
    clouds = (measurement.cloud(int(frame)) for frame in measurement.seen_frames)
    return {hashlib.blake2b(cloud.tobytes()).digest() for cloud in clouds}


def _lengths(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Lengths (..., E) [m] of the edges of a mesh at vertices (..., V, 3)."""
    a, b = edges(faces).T
    return np.linalg.norm(vertices[..., a, :] - vertices[..., b, :], axis=-1)


def _check_edges(vertices: np.ndarray, scene: Scene, where: str) -> None:
    length = _lengths(vertices, scene.garment.faces) / _lengths(scene.garment.vertices, scene.garment.faces)
    if not np.isfinite(length).any():
        raise CaphyError(
            f"{where}: no edge of the cloth's mesh has both of its ends measured, so that its scale and the order of "
            "its vertices cannot be checked; give a mesh of what was measured (sparse markers: their own, coarser one)"
        )
    low, middle, high = np.nanquantile(length, (0.1, 0.5, 0.9))
    if high > _SPREAD * low:
        raise CaphyError(
            f"{where}: measured vertices must follow the cloth's mesh, but their edges are {low:.2g} to {high:.2g} "
            "times as long as at rest: vertices in another order, another mesh, or more noise than motion"
        )
    if not _SIZE[0] < middle < _SIZE[1]:
        raise CaphyError(
            f"{where}: the measured edges must be about as long as the cloth's at rest, but their median is "
            f"{middle:.3g} times that; give metres, and the rest shape of the cloth that was measured"
        )


def _check_order(vertices: np.ndarray, scene: Scene, where: str) -> None:
    near = np.nanmedian(np.linalg.norm(vertices[1:-1] - vertices[:-2], axis=-1))
    far = np.nanmedian(np.linalg.norm(vertices[2:] - vertices[:-2], axis=-1))
    noise = measurement_noise(scene.measurement)
    stated = noise is not None and noise.source.startswith("stated")
    still = far < _STILL * (noise.sigma if noise is not None and stated else 0.0) + 2e-3
    ratio = 0.0 if still else float(near / far)
    if ratio > _TURNS:
        raise CaphyError(
            f"{where}: neighbouring frames must be near each other, but vertices move {ratio:.2g} times as far in one "
            "frame as in two: put the frames in order of time"
        )
