"""The binary messages of ``POST /avatars/{avatar}/frames``, little-endian throughout; docs/protocol.md is their text.

Both sides of the wire use this file, so that it can only be wrong on both.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from caphy.errors import CaphyError

MEDIA_TYPE: Final = "application/octet-stream"
VERSION: Final = 1
REQUEST_HEADER: Final = struct.Struct("<4sHHIIfI")
"""magic "CPHQ", version, reserved 0, frames, joints, fps, state floats."""
RESPONSE_HEADER: Final = struct.Struct("<4sHHIff")
"""magic "CPHR", version, garments, frames, fps, fps of the request."""
GARMENT_HEADER: Final = struct.Struct("<40sII")
"""name in ASCII padded with zeros, vertices, state floats."""
FLOAT: Final = np.dtype("<f4")


@dataclass(frozen=True, eq=False)
class FramesRequest:
    """Poses (T, J, 3) [rad], transl (T, 3) [m], fps [Hz], and the garments' states one after another (S,) or empty."""

    poses: np.ndarray
    transl: np.ndarray
    fps: float
    state: np.ndarray


@dataclass(frozen=True, eq=False)
class FramesResponse:
    """Per garment vertices (T, V, 3) [m] and the state (S,) after the last frame; at ``fps`` [Hz], resampled from
    ``request_fps`` where they differ."""

    vertices: Mapping[str, np.ndarray]
    states: Mapping[str, np.ndarray]
    fps: float
    request_fps: float


def encode_request(request: FramesRequest) -> bytes:
    """The bytes of a request."""
    frames, joints, _ = request.poses.shape
    header = REQUEST_HEADER.pack(b"CPHQ", VERSION, 0, frames, joints, request.fps, request.state.size)
    arrays = (request.poses, request.transl, request.state)
    return b"".join([header, *(np.ascontiguousarray(a, FLOAT).tobytes() for a in arrays)])


def decode_request(body: bytes) -> FramesRequest:
    """The request of ``body``; raises CaphyError where the bytes are not one."""
    if len(body) < REQUEST_HEADER.size:
        raise CaphyError(f"a request starts with a header of {REQUEST_HEADER.size} bytes, got {len(body)} in all")
    magic, version, reserved, frames, joints, fps, states = REQUEST_HEADER.unpack_from(body)
    if magic != b"CPHQ" or version != VERSION or reserved != 0:
        raise CaphyError(
            f"a request starts with CPHQ, version {VERSION} and 0, got {magic!r}, {version} and {reserved}"
        )
    expected = REQUEST_HEADER.size + 4 * (frames * joints * 3 + frames * 3 + states)
    if len(body) != expected:
        raise CaphyError(
            f"{frames} frames of {joints} joints and {states} state floats make {expected} bytes, got {len(body)}"
        )
    floats = np.frombuffer(body, FLOAT, offset=REQUEST_HEADER.size)
    poses, transl, state = np.split(floats, [frames * joints * 3, frames * (joints + 1) * 3])
    return FramesRequest(poses.reshape(frames, joints, 3), transl.reshape(frames, 3), float(fps), state)


def encode_response(response: FramesResponse) -> list[bytes | memoryview]:
    """The parts of a response's bytes, in order; vertices are not copied."""
    frames = len(next(iter(response.vertices.values())))
    header = RESPONSE_HEADER.pack(b"CPHR", VERSION, len(response.vertices), frames, response.fps, response.request_fps)
    parts: list[bytes | memoryview] = [header]
    for name, vertices in response.vertices.items():
        parts.append(GARMENT_HEADER.pack(name.encode("ascii"), vertices.shape[1], response.states[name].size))
    for name, vertices in response.vertices.items():
        for array in (vertices, response.states[name]):
            parts.append(np.ascontiguousarray(array, FLOAT).reshape(-1).view(np.uint8).data)
    return parts


def decode_response(body: bytes) -> FramesResponse:
    """The response of ``body``; raises CaphyError where the bytes are not one."""
    try:
        magic, version, count, frames, fps, request_fps = RESPONSE_HEADER.unpack_from(body)
        if magic != b"CPHR" or version != VERSION:
            raise CaphyError(f"a response starts with CPHR and version {VERSION}, got {magic!r} and {version}")
        start = RESPONSE_HEADER.size
        records = [GARMENT_HEADER.unpack_from(body, start + i * GARMENT_HEADER.size) for i in range(count)]
        offset = start + count * GARMENT_HEADER.size
        vertices, states = {}, {}
        for padded, size, state_size in records:
            name = padded.rstrip(b"\0").decode("ascii")
            vertices[name] = np.frombuffer(body, FLOAT, frames * size * 3, offset).reshape(frames, size, 3)
            offset += 4 * frames * size * 3
            states[name] = np.frombuffer(body, FLOAT, state_size, offset)
            offset += 4 * state_size
    except (struct.error, ValueError) as error:
        raise CaphyError(f"the response is cut short or is none: {error}") from error
    return FramesResponse(vertices, states, fps, request_fps)
