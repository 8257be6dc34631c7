"""How meshes are packed into bytes, little-endian: in answers over HTTP and in messages of a stream alike.

Every block starts at a multiple of four bytes and is padded with zeros to one, so that a client can look at it in
place. docs/protocol.md is the text of this file, with the worst error of each encoding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final, Literal

import numpy as np

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError
from service.errors import Problem

Part = bytes | memoryview


class Encoding(IntEnum):
    """The number of an encoding on the wire."""

    FLOAT32 = 0
    FLOAT16 = 1
    UINT16 = 2
    WEIGHTS = 3

    @property
    def label(self) -> str:
        """Its name in a query."""
        return self.name.lower()


EncodingName = Literal["float32", "float16", "uint16", "weights"]
LABELS: Final = tuple(encoding.label for encoding in Encoding)
NORMAL_SCALE: Final = 127
QUANTUM: Final = 65535
HALF_MAX: Final = float(np.finfo(np.float16).max)


@dataclass(frozen=True, eq=False)
class JointMotion:
    """What poses the skeleton of the avatar's GLB: root (T, 3) [m], the pelvis node's translation, and rotations
    (T, 55, 4) of all joints relative to their parents, unit quaternions in glTF's order x y z w."""

    root: np.ndarray
    rotations: np.ndarray


@dataclass(frozen=True, eq=False)
class Meshes:
    """T frames of some garments, as one encoding carries them.

    vertices: per garment (T, V, 3) [m], empty for WEIGHTS. normals: per garment (T, V, 3), unit, where asked for.
    weights: per garment the blend shapes' (T, R), for WEIGHTS only, as are joints.
    """

    frames: int
    vertices: Mapping[str, np.ndarray] = field(default_factory=dict)
    normals: Mapping[str, np.ndarray] = field(default_factory=dict)
    weights: Mapping[str, np.ndarray] = field(default_factory=dict)
    joints: JointMotion | None = None


def encode_meshes(meshes: Meshes, encoding: Encoding) -> list[Part]:
    """The parts of the bytes, in order; float32 vertices are not copied."""
    if encoding is Encoding.WEIGHTS:
        if meshes.joints is None:
            raise ValueError("weights need the joints' motion")
        parts = _raw(meshes.joints.root, "<f4") + _raw(meshes.joints.rotations, "<f4")
        return parts + [part for weights in meshes.weights.values() for part in _halves(weights)]
    parts = []
    for name, vertices in meshes.vertices.items():
        parts += ENCODERS[encoding](vertices)
        if name in meshes.normals:
            parts += _encode_normals(meshes.normals[name])
    return parts


def decode_meshes(
    body: bytes, offset: int, encoding: Encoding, frames: int, counts: Mapping[str, int], normals: bool
) -> tuple[Meshes, int]:
    """The meshes at ``offset``, and the offset after them; ``counts`` holds V, or R for WEIGHTS, per garment.

    Vertices are float32 whatever carried them. Raises CaphyError where the bytes end too early.
    """
    reader = _Reader(body, offset)
    try:
        if encoding is Encoding.WEIGHTS:
            joints = JointMotion(reader.take("<f4", frames, 3), reader.take("<f4", frames, JOINT_COUNT, 4))
            weights = {name: reader.take("<f2", frames, count).astype("f4") for name, count in counts.items()}
            return Meshes(frames, weights=weights, joints=joints), reader.offset
        vertices, found = {}, {}
        for name, count in counts.items():
            vertices[name] = DECODERS[encoding](reader, frames, count)
            if normals:
                found[name] = reader.take("i1", frames, count, 4)[..., :3].astype("f4") / NORMAL_SCALE
    except ValueError as error:
        raise CaphyError(f"the meshes are cut short: {error}") from error
    return Meshes(frames, vertices, found), reader.offset


class _Reader:
    """Takes arrays off a buffer one after another, each padded to four bytes."""

    def __init__(self, body: bytes, offset: int) -> None:
        self.body, self.offset = body, offset

    def take(self, dtype: str, *shape: int) -> np.ndarray:
        count = int(np.prod(shape, dtype=np.int64))
        size = count * np.dtype(dtype).itemsize
        end = self.offset + size + -size % 4
        if end > len(self.body):
            raise ValueError(f"{end} bytes are needed, {len(self.body)} are there")
        array = np.frombuffer(self.body, dtype, count, self.offset).reshape(shape)
        self.offset = end
        return array


def _raw(array: np.ndarray, dtype: str) -> list[Part]:
    flat = np.ascontiguousarray(array, dtype).reshape(-1).view(np.uint8)
    return [flat.data, bytes(-len(flat) % 4)] if len(flat) % 4 else [flat.data]


def _halves(array: np.ndarray) -> list[Part]:
    """Half floats; raises Problem 422 for what they cannot hold, which would become infinite."""
    if not -HALF_MAX <= array.min(initial=0) <= array.max(initial=0) <= HALF_MAX:
        raise Problem(422, f"a garment left the half floats (within {HALF_MAX:g}); ask for float32")
    return _raw(array, "<f2")


def _planes(vertices: np.ndarray) -> np.ndarray:
    """A float32 copy (T, 3, V): arithmetic on rows of three is slow."""
    return np.array(vertices.transpose(0, 2, 1), np.float32, order="C")


def _encode_float32(vertices: np.ndarray) -> list[Part]:
    return _raw(vertices, "<f4")


def _decode_float32(reader: _Reader, frames: int, count: int) -> np.ndarray:
    return reader.take("<f4", frames, count, 3)


def _encode_float16(vertices: np.ndarray) -> list[Part]:
    """Offsets from the middle of each frame's bounds: half floats are fine only near zero."""
    planes = _planes(vertices)
    centre = 0.5 * (planes.min(axis=2) + planes.max(axis=2))
    planes -= centre[:, :, None]
    return _raw(centre, "<f4") + _halves(planes.transpose(0, 2, 1))


def _decode_float16(reader: _Reader, frames: int, count: int) -> np.ndarray:
    centre = reader.take("<f4", frames, 3)
    return centre[:, None] + reader.take("<f2", frames, count, 3).astype("f4")


def _encode_uint16(vertices: np.ndarray) -> list[Part]:
    """Steps from the low corner of each frame's bounds."""
    planes = _planes(vertices)
    low = planes.min(axis=2)
    step = (planes.max(axis=2) - low) / np.float32(QUANTUM)
    inverse = np.divide(1, step, out=np.zeros_like(step), where=step > 0)
    planes -= low[:, :, None]
    planes *= inverse[:, :, None]
    planes += np.float32(0.5)
    steps = np.minimum(planes, QUANTUM, out=planes).astype("<u2")
    return _raw(low, "<f4") + _raw(step, "<f4") + _raw(steps.transpose(0, 2, 1), "<u2")


def _decode_uint16(reader: _Reader, frames: int, count: int) -> np.ndarray:
    low, step = reader.take("<f4", frames, 3), reader.take("<f4", frames, 3)
    return low[:, None] + step[:, None] * reader.take("<u2", frames, count, 3).astype("f4")


def _encode_normals(normals: np.ndarray) -> list[Part]:
    """x y z 0 as signed bytes: graphics cards want attributes at multiples of four bytes."""
    padded = np.zeros((*normals.shape[:2], 4), np.int8)
    padded[..., :3] = np.rint(normals * NORMAL_SCALE)
    return _raw(padded, "i1")


ENCODERS: Final = {
    Encoding.FLOAT32: _encode_float32,
    Encoding.FLOAT16: _encode_float16,
    Encoding.UINT16: _encode_uint16,
}
DECODERS: Final = {
    Encoding.FLOAT32: _decode_float32,
    Encoding.FLOAT16: _decode_float16,
    Encoding.UINT16: _decode_uint16,
}
