"""The binary messages of a stream, little-endian throughout; docs/stream.md is their text.

Both sides of the wire use this file; the vectors under tests/service/vectors were written without it.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

import numpy as np

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError
from service.encodings import Encoding, Meshes, Part, decode_meshes, encode_meshes

MAGIC: Final = b"CPHS"
VERSION: Final = 1
HEADER: Final = struct.Struct("<4sBBHIId")
"""magic, version, type, count, number, extra, time; the same for every message."""
HELLO: Final = struct.Struct("<fHBB")
"""fps of the poses, credits, encoding, flags."""
WELCOME: Final = struct.Struct("<fHH")
"""fps of the avatar, most frames of one message, most credits."""
MESHES: Final = struct.Struct("<If")
"""tick of the first mesh, milliseconds between the poses' arrival and this message."""
CONDITIONED: Final = struct.Struct("<d")
"""The moment of the first mesh [s], in the answers of a conditioned stream; a byte for each frame follows."""
RATE: Final = struct.Struct("<f")
NAME: Final = struct.Struct("<40s")
GARMENT: Final = struct.Struct("<40sII")
"""name in ASCII padded with zeros, vertices (or blend shapes, where weights are sent), state floats."""
MOST_CREDITS: Final = 2**16 - 1
"""That a hello can hold; the service may allow fewer."""
NORMALS: Final = 1
FLOAT: Final = np.dtype("<f4")
POSE_FLOATS: Final = 3 * JOINT_COUNT + 3


class Kind(IntEnum):
    """The type of a message: below 128 from the client, above from the server."""

    HELLO = 1
    POSES = 2
    CREDIT = 3
    RESET = 4
    RATE = 5
    GET_STATE = 6
    SEEN = 7
    WELCOME = 129
    MESHES = 130
    STATE = 131
    ERROR = 132


KINDS: Final = {kind.value: kind for kind in Kind}
ENCODINGS: Final = {encoding.value: encoding for encoding in Encoding}


@dataclass(frozen=True, eq=False)
class Hello:
    """The first message: garments (all where none is named), how to pack them, the poses' rate [Hz], credits, and the
    states (S,) of an earlier stream to continue, one after another, or none.

    conditioning: "" for none, "on", or settings in JSON, see docs/conditioning.md.
    """

    garments: tuple[str, ...]
    fps: float
    encoding: Encoding = Encoding.FLOAT32
    normals: bool = False
    credits: int = 2
    state: np.ndarray = field(default_factory=lambda: np.zeros(0, FLOAT))
    conditioning: str = ""


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses (T, 55, 3) [rad] and transl (T, 3) [m]; ``number`` is that of the first, ``time`` [s] comes back."""

    number: int
    time: float
    poses: np.ndarray
    transl: np.ndarray


@dataclass(frozen=True, eq=False)
class Seen(Poses):
    """Poses of a conditioned stream with their own ``times`` (T,) [s] and ``confidence`` (T, 55) from 0 to 1; 0 in all
    joints is a frame in which nobody was seen."""

    times: np.ndarray
    confidence: np.ndarray


@dataclass(frozen=True)
class Credit:
    """The client may take ``count`` more answers."""

    count: int


@dataclass(frozen=True)
class Reset:
    """The next pose starts a new motion."""


@dataclass(frozen=True)
class Rate:
    """The poses from here on come at ``fps`` [Hz]."""

    fps: float


@dataclass(frozen=True)
class GetState:
    """Asks for the states after all poses sent so far; ``time`` [s] comes back."""

    time: float = 0.0


@dataclass(frozen=True)
class GarmentRecord:
    """What a stream says of a garment: ``count`` vertices, or blend shapes where weights are sent."""

    name: str
    count: int
    state_size: int


@dataclass(frozen=True)
class Welcome:
    """The stream begins: the avatar's rate [Hz], the limits, and the garments in the order of the meshes; and how much
    later than without conditioning a moment is shown [s], 0 where there is none."""

    fps: float
    max_frames: int
    max_credits: int
    garments: tuple[GarmentRecord, ...]
    latency: float = 0.0


@dataclass(frozen=True, eq=False)
class Dressed:
    """The answer to a message of poses.

    number: of the newest pose taken in. skipped: messages of poses so far that were taken in and not answered.
    time: as the poses' message had it [s]. tick: index of the first mesh, at the avatar's rate, since hello or reset.
    milliseconds: between the poses' arrival and this message's departure. did, shown: of a conditioned stream, what
    was done to each frame (T,) uint8, see :class:`caphy.conditioning.Did`, and the moment of the first mesh on the
    poses' clock [s]; none and 0 of others.
    """

    number: int
    skipped: int
    time: float
    tick: int
    milliseconds: float
    meshes: Meshes
    did: np.ndarray | None = None
    shown: float = 0.0


@dataclass(frozen=True, eq=False)
class State:
    """The states (S,) of all garments, one after another, after the pose of ``number``."""

    number: int
    time: float
    state: np.ndarray


@dataclass(frozen=True)
class Failure:
    """What went wrong, with HTTP's code for it; ``number`` is that of the first pose of the message refused, or 0."""

    code: int
    text: str
    number: int = 0


ClientMessage = Hello | Poses | Credit | Reset | Rate | GetState
ServerMessage = Welcome | Dressed | State | Failure


def encode_client(message: ClientMessage) -> bytes:
    """The bytes of a message to the server."""
    match message:
        case Hello():
            rates = HELLO.pack(message.fps, message.credits, message.encoding, NORMALS if message.normals else 0)
            names = [NAME.pack(name.encode("ascii")) for name in message.garments]
            text = message.conditioning.encode()
            head = _header(Kind.HELLO, len(names), len(text), message.state.size)
            return b"".join([head, rates, *names, _floats(message.state), text])
        case Poses():
            kind = Kind.SEEN if isinstance(message, Seen) else Kind.POSES
            head = _header(kind, len(message.poses), message.number, time=message.time)
            parts = [head, _floats(message.poses), _floats(message.transl)]
            if isinstance(message, Seen):
                times = np.ascontiguousarray(message.times, "<f8").tobytes()
                parts = [head, times, *parts[1:], _floats(message.confidence)]
            return b"".join(parts)
        case Credit():
            return _header(Kind.CREDIT, extra=message.count)
        case Reset():
            return _header(Kind.RESET)
        case Rate():
            return _header(Kind.RATE) + RATE.pack(message.fps)
        case GetState():
            return _header(Kind.GET_STATE, time=message.time)


def largest_seen(count: int) -> int:
    """Bytes of a message of ``count`` poses with times and confidences, which none with as many exceeds."""
    return HEADER.size + count * (8 + 4 * (POSE_FLOATS + JOINT_COUNT))


def decode_client(body: bytes) -> ClientMessage:
    """The client's message in ``body``; raises CaphyError where the bytes are none."""
    kind, count, number, extra, time = _read_header(body)
    match kind:
        case Kind.HELLO:
            return _decode_hello(body, count, number, extra)
        case Kind.POSES:
            _require_length(body, HEADER.size + 4 * count * POSE_FLOATS, f"{count} poses of {JOINT_COUNT} joints")
            _require_numbers(number, count)
            return Poses(number, time, *_split(np.frombuffer(body, FLOAT, offset=HEADER.size), count)[:2])
        case Kind.SEEN:
            expected = largest_seen(count)
            _require_length(body, expected, f"{count} poses of {JOINT_COUNT} joints with times and confidence")
            _require_numbers(number, count)
            times = np.frombuffer(body, "<f8", count, HEADER.size)
            poses, transl, rest = _split(np.frombuffer(body, FLOAT, offset=HEADER.size + 8 * count), count)
            return Seen(number, time, poses, transl, times, rest.reshape(count, JOINT_COUNT))
        case Kind.CREDIT | Kind.RESET | Kind.GET_STATE:
            _require_length(body, HEADER.size, f"a message of type {kind.value}")
            return {Kind.CREDIT: Credit(extra), Kind.RESET: Reset()}.get(kind, GetState(time))
        case Kind.RATE:
            _require_length(body, HEADER.size + RATE.size, "a message of type 5")
            return Rate(RATE.unpack_from(body, HEADER.size)[0])
    raise CaphyError(f"type {kind.value} is one of the server's, a client sends {_types(False)}")


def _split(floats: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses (T, 55, 3), transl (T, 3), and what comes after them."""
    poses, transl, rest = np.split(floats, [3 * JOINT_COUNT * count, POSE_FLOATS * count])
    return poses.reshape(count, JOINT_COUNT, 3), transl.reshape(count, 3), rest


def _decode_hello(body: bytes, count: int, letters: int, states: int) -> Hello:
    start = HEADER.size + HELLO.size
    end = start + NAME.size * count + 4 * states
    _require_length(body, end + letters, f"hello with {count} garments, {states} state floats, {letters} letters")
    fps, credits, code, flags = HELLO.unpack_from(body, HEADER.size)
    if code not in ENCODINGS:
        raise CaphyError(f"the encoding must be one of {list(ENCODINGS)}, got {code}")
    if flags & ~NORMALS:
        raise CaphyError(f"flags must be 0 or {NORMALS}, got {flags}")
    names = tuple(_name(NAME.unpack_from(body, start + i * NAME.size)[0]) for i in range(count))
    state = np.frombuffer(body, FLOAT, states, start + NAME.size * count)
    try:
        text = body[end:].decode()
    except UnicodeDecodeError as error:
        raise CaphyError(f"the settings of conditioning must be UTF-8, got {body[end : end + 40]!r}") from error
    return Hello(names, fps, ENCODINGS[code], bool(flags), credits, state, text)


def encode_welcome(message: Welcome) -> bytes:
    """The bytes of the server's first message."""
    states = sum(garment.state_size for garment in message.garments)
    head = _header(Kind.WELCOME, len(message.garments), extra=states, time=message.latency)
    records = [GARMENT.pack(g.name.encode("ascii"), g.count, g.state_size) for g in message.garments]
    return b"".join([head, WELCOME.pack(message.fps, message.max_frames, message.max_credits), *records])


def encode_meshes_message(message: Dressed, encoding: Encoding) -> list[Part]:
    """The parts of the bytes of an answer, in order."""
    head = _header(Kind.MESHES, message.meshes.frames, message.number, message.skipped, message.time)
    parts = [head, MESHES.pack(message.tick, message.milliseconds)]
    if message.did is not None:
        did = np.ascontiguousarray(message.did, np.uint8).tobytes()
        parts += [CONDITIONED.pack(message.shown), did, bytes(-len(did) % 4)]
    return [*parts, *encode_meshes(message.meshes, encoding)]


def encode_state(message: State) -> bytes:
    """The bytes of the states asked for."""
    return _header(Kind.STATE, 0, message.number, message.state.size, message.time) + _floats(message.state)


def encode_failure(message: Failure) -> bytes:
    """The bytes of an error; its text is cut to 2,000 bytes."""
    text = message.text.encode()[:2000].decode(errors="ignore").encode()
    return _header(Kind.ERROR, 0, message.number, message.code) + text


@dataclass
class ServerDecoder:
    """Reads the server's messages; what the client chose and the welcome said tells how meshes are packed."""

    encoding: Encoding
    normals: bool
    counts: Mapping[str, int] = field(default_factory=dict)
    conditioned: bool = False

    def decode(self, body: bytes) -> ServerMessage:
        """The server's message in ``body``; raises CaphyError where the bytes are none."""
        kind, count, number, extra, time = _read_header(body)
        try:
            match kind:
                case Kind.WELCOME:
                    return self._welcome(body, count, time)
                case Kind.MESHES:
                    tick, milliseconds = MESHES.unpack_from(body, HEADER.size)
                    did, shown, start = self._conditions(body, count)
                    meshes, _ = decode_meshes(body, start, self.encoding, count, self.counts, self.normals)
                    return Dressed(number, extra, time, tick, milliseconds, meshes, did, shown)
                case Kind.STATE:
                    return State(number, time, np.frombuffer(body, FLOAT, extra, HEADER.size))
                case Kind.ERROR:
                    return Failure(extra, body[HEADER.size :].decode(errors="replace"), number)
        except (struct.error, ValueError) as error:
            raise CaphyError(f"the message of type {kind.value} is cut short: {error}") from error
        raise CaphyError(f"type {kind.value} is one of the client's, a server sends {_types(True)}")

    def _conditions(self, body: bytes, frames: int) -> tuple[np.ndarray | None, float, int]:
        """What was done to the frames, the moment of the first, and where the meshes start."""
        start = HEADER.size + MESHES.size
        if not self.conditioned:
            return None, 0.0, start
        (shown,) = CONDITIONED.unpack_from(body, start)
        start += CONDITIONED.size
        return np.frombuffer(body, np.uint8, frames, start), shown, start + frames + -frames % 4

    def _welcome(self, body: bytes, count: int, latency: float) -> Welcome:
        start = HEADER.size + WELCOME.size
        records = [GARMENT.unpack_from(body, start + i * GARMENT.size) for i in range(count)]
        garments = tuple(GarmentRecord(_name(name), vertices, states) for name, vertices, states in records)
        self.counts = {garment.name: garment.count for garment in garments}
        fps, frames, most = WELCOME.unpack_from(body, HEADER.size)
        return Welcome(fps, frames, most, garments, latency)


def _require_numbers(first: int, count: int) -> None:
    """Answers carry the number of the newest pose, in 32 bits."""
    if first + count > 1 << 32:
        raise CaphyError(f"numbers of poses must be below 2^32, got {count} from {first} on; reset starts a new motion")


def _header(kind: Kind, count: int = 0, number: int = 0, extra: int = 0, time: float = 0.0) -> bytes:
    return HEADER.pack(MAGIC, VERSION, kind, count, number, extra, time)


def _read_header(body: bytes) -> tuple[Kind, int, int, int, float]:
    if len(body) < HEADER.size:
        raise CaphyError(f"a message starts with a header of {HEADER.size} bytes, got {len(body)} in all")
    magic, version, code, count, number, extra, time = HEADER.unpack_from(body)
    if magic != MAGIC or version != VERSION:
        raise CaphyError(f"a message starts with CPHS and version {VERSION}, got {magic!r} and {version}")
    kind = KINDS.get(code)
    if kind is None:
        raise CaphyError(f"there is no message of type {code}")
    return kind, count, number, extra, time


def _require_length(body: bytes, expected: int, what: str) -> None:
    if len(body) != expected:
        raise CaphyError(f"{what} makes {expected} bytes, got {len(body)}")


def _name(padded: bytes) -> str:
    try:
        return padded.rstrip(b"\0").decode("ascii")
    except UnicodeDecodeError as error:
        raise CaphyError(f"names are ASCII padded with zeros, got {padded[:40]!r}") from error


def _types(server: bool) -> Sequence[int]:
    return [kind.value for kind in Kind if (kind.value > 128) == server]


def _floats(array: np.ndarray) -> bytes:
    return np.ascontiguousarray(array, FLOAT).tobytes()
