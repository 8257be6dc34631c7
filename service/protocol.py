"""The binary messages of ``POST /avatars/{avatar}/frames``, little-endian throughout; docs/protocol.md is their text.

Both sides of the wire use this file, so that it can only be wrong on both.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from caphy.errors import CaphyError
from service.encodings import Encoding, JointMotion, Meshes, Part, decode_meshes, encode_meshes

MEDIA_TYPE: Final = "application/octet-stream"
VERSION: Final = 1
REQUEST_HEADER: Final = struct.Struct("<4sHHIIfI")
"""magic "CPHQ", version, flags (0 in version 1), frames, joints, fps, state floats."""
SEEN_VERSION: Final = 2
"""Of requests with times or confidence, for conditioned motions."""
TIMES: Final = 1
"""Flag of version 2: times (T,) float64 follow the states."""
CONFIDENCE: Final = 2
"""Flag of version 2: confidence (T, J) float32 follows at the end."""
RESPONSE_HEADER: Final = struct.Struct("<4sHHIff")
"""magic "CPHR", version, garments, frames, fps, fps of the request."""
ENCODED_HEADER: Final = struct.Struct("<4sHHIffBBH")
"""The same of version 2, then encoding, flags, reserved 0; for every answer that is not plain float32."""
ENCODED_VERSION: Final = 2
NORMALS: Final = 1
"""Flag of version 2: each garment's vertices are followed by their normals."""
GARMENT_HEADER: Final = struct.Struct("<40sII")
"""name in ASCII padded with zeros, vertices (or blend shapes, where weights are sent), state floats."""
FLOAT: Final = np.dtype("<f4")


@dataclass(frozen=True, eq=False)
class FramesRequest:
    """Poses (T, J, 3) [rad], transl (T, 3) [m], fps [Hz], and the garments' states one after another (S,) or empty.

    times (T,) [s] and confidence (T,) or (T, J): of motions to be conditioned, where they are known.
    """

    poses: np.ndarray
    transl: np.ndarray
    fps: float
    state: np.ndarray
    times: np.ndarray | None = None
    confidence: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class FramesResponse:
    """Per garment vertices (T, V, 3) [m] and the state (S,) after the last frame; at ``fps`` [Hz], resampled from
    ``request_fps`` where they differ.

    normals, weights, joints: as in :class:`service.encodings.Meshes`; with weights there are no vertices.
    """

    vertices: Mapping[str, np.ndarray]
    states: Mapping[str, np.ndarray]
    fps: float
    request_fps: float
    encoding: Encoding = Encoding.FLOAT32
    normals: Mapping[str, np.ndarray] = field(default_factory=dict)
    weights: Mapping[str, np.ndarray] = field(default_factory=dict)
    joints: JointMotion | None = None
    conditioning: Mapping[str, Any] | None = None
    """What was done to the poses, where they were conditioned; over the wire it is a header of the answer."""

    @property
    def meshes(self) -> Meshes:
        """What the encodings pack."""
        frames = len(next(iter((self.vertices or self.weights).values())))
        return Meshes(frames, self.vertices, self.normals, self.weights, self.joints)


def encode_request(request: FramesRequest) -> bytes:
    """The bytes of a request."""
    frames, joints, _ = request.poses.shape
    flags = TIMES * (request.times is not None) | CONFIDENCE * (request.confidence is not None)
    version = SEEN_VERSION if flags else VERSION
    header = REQUEST_HEADER.pack(b"CPHQ", version, flags, frames, joints, request.fps, request.state.size)
    parts = [
        header,
        *(np.ascontiguousarray(a, FLOAT).tobytes() for a in (request.poses, request.transl, request.state)),
    ]
    if request.times is not None:
        parts.append(np.ascontiguousarray(request.times, "<f8").tobytes())
    if request.confidence is not None:
        confidence = request.confidence if request.confidence.ndim == 2 else request.confidence[:, None]
        parts.append(np.ascontiguousarray(np.broadcast_to(confidence, (frames, joints)), FLOAT).tobytes())
    return b"".join(parts)


def decode_request(body: bytes) -> FramesRequest:
    """The request of ``body``; raises CaphyError where the bytes are not one."""
    if len(body) < REQUEST_HEADER.size:
        raise CaphyError(f"a request starts with a header of {REQUEST_HEADER.size} bytes, got {len(body)} in all")
    magic, version, flags, frames, joints, fps, states = REQUEST_HEADER.unpack_from(body)
    known = TIMES | CONFIDENCE if version == SEEN_VERSION else 0
    if magic != b"CPHQ" or version not in (VERSION, SEEN_VERSION) or flags & ~known:
        raise CaphyError(
            f"a request starts with CPHQ, version {VERSION} and 0 (or {SEEN_VERSION} and flags), got {magic!r}, "
            f"{version} and {flags}"
        )
    plain = REQUEST_HEADER.size + 4 * (frames * joints * 3 + frames * 3 + states)
    timed = 8 * frames if flags & TIMES else 0
    expected = plain + timed + (4 * frames * joints if flags & CONFIDENCE else 0)
    if len(body) != expected:
        raise CaphyError(
            f"{frames} frames of {joints} joints and {states} state floats make {expected} bytes, got {len(body)}"
        )
    floats = np.frombuffer(body, FLOAT, (plain - REQUEST_HEADER.size) // 4, REQUEST_HEADER.size)
    poses, transl, state = np.split(floats, [frames * joints * 3, frames * (joints + 1) * 3])
    times = np.frombuffer(body, "<f8", frames, plain) if flags & TIMES else None
    confidence = np.frombuffer(body, FLOAT, frames * joints, plain + timed) if flags & CONFIDENCE else None
    return FramesRequest(
        poses.reshape(frames, joints, 3),
        transl.reshape(frames, 3),
        float(fps),
        state,
        times,
        None if confidence is None else confidence.reshape(frames, joints),
    )


def encode_response(response: FramesResponse) -> list[Part]:
    """The parts of a response's bytes, in order; float32 vertices are not copied."""
    if response.encoding is Encoding.FLOAT32 and not response.normals:
        return _encode_plain(response)
    meshes, states = response.meshes, response.states
    flags = NORMALS if response.normals else 0
    rates = response.fps, response.request_fps
    parts: list[Part] = [
        ENCODED_HEADER.pack(
            b"CPHR", ENCODED_VERSION, len(states), meshes.frames, *rates, response.encoding.value, flags, 0
        )
    ]
    for name, array in (meshes.vertices or meshes.weights).items():
        parts.append(GARMENT_HEADER.pack(name.encode("ascii"), array.shape[1], states[name].size))
    parts += encode_meshes(meshes, response.encoding)
    return parts + [_floats(state) for state in states.values()]


def _encode_plain(response: FramesResponse) -> list[Part]:
    """Version 1, which anybody can read in a few lines: vertices and state of one garment after another."""
    frames = len(next(iter(response.vertices.values())))
    header = RESPONSE_HEADER.pack(b"CPHR", VERSION, len(response.vertices), frames, response.fps, response.request_fps)
    parts: list[Part] = [header]
    for name, vertices in response.vertices.items():
        parts.append(GARMENT_HEADER.pack(name.encode("ascii"), vertices.shape[1], response.states[name].size))
    for name, vertices in response.vertices.items():
        parts += [_floats(vertices), _floats(response.states[name])]
    return parts


def _floats(array: np.ndarray) -> memoryview:
    return np.ascontiguousarray(array, FLOAT).reshape(-1).view(np.uint8).data


def decode_response(body: bytes) -> FramesResponse:
    """The response of ``body``; raises CaphyError where the bytes are not one."""
    try:
        magic, version = struct.unpack_from("<4sH", body)
        if magic != b"CPHR" or version not in (VERSION, ENCODED_VERSION):
            raise CaphyError(f"a response starts with CPHR and version 1 or 2, got {magic!r} and {version}")
        return _decode_plain(body) if version == VERSION else _decode_encoded(body)
    except (struct.error, ValueError) as error:
        raise CaphyError(f"the response is cut short or is none: {error}") from error


def _decode_plain(body: bytes) -> FramesResponse:
    _, _, count, frames, fps, request_fps = RESPONSE_HEADER.unpack_from(body)
    records, offset = _records(body, RESPONSE_HEADER.size, count)
    vertices, states = {}, {}
    for name, size, state_size in records:
        vertices[name] = np.frombuffer(body, FLOAT, frames * size * 3, offset).reshape(frames, size, 3)
        offset += 4 * frames * size * 3
        states[name] = np.frombuffer(body, FLOAT, state_size, offset)
        offset += 4 * state_size
    return FramesResponse(vertices, states, fps, request_fps)


def _decode_encoded(body: bytes) -> FramesResponse:
    _, _, count, frames, fps, request_fps, code, flags, _ = ENCODED_HEADER.unpack_from(body)
    encoding = Encoding(code)
    records, offset = _records(body, ENCODED_HEADER.size, count)
    counts = {name: size for name, size, _ in records}
    meshes, offset = decode_meshes(body, offset, encoding, frames, counts, bool(flags & NORMALS))
    states = {}
    for name, _, state_size in records:
        states[name] = np.frombuffer(body, FLOAT, state_size, offset)
        offset += 4 * state_size
    return FramesResponse(
        meshes.vertices, states, fps, request_fps, encoding, meshes.normals, meshes.weights, meshes.joints
    )


def _records(body: bytes, offset: int, count: int) -> tuple[list[tuple[str, int, int]], int]:
    """Name, vertices and state floats of each garment, and the offset after them."""
    found = [GARMENT_HEADER.unpack_from(body, offset + i * GARMENT_HEADER.size) for i in range(count)]
    return [(name.rstrip(b"\0").decode("ascii"), v, s) for name, v, s in found], offset + count * GARMENT_HEADER.size
