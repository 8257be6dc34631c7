"""Streams of clients that are broken, slow, gone or hostile: refused in words, bounded, and nobody else notices."""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from base64 import b64encode
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from unittest.mock import patch
from urllib.parse import urlsplit

import numpy as np
import pytest
import uvicorn
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from service.app import create_app
from service.clients.stream import StreamClient
from service.encodings import Encoding
from service.metrics import resident_bytes
from service.settings import Settings
from service.stream.messages import (
    Credit,
    Failure,
    GetState,
    Hello,
    Poses,
    Rate,
    Reset,
    ServerDecoder,
    encode_client,
)

MESSAGES = 6000
STREAMS = 8
STRICT = {"HELLO_SECONDS": "1", "IDLE_SECONDS": "3", "SEND_SECONDS": "3", "MAX_CLIENT_STREAMS": str(STREAMS)}


@pytest.fixture(scope="module")
def strict(avatars: Path) -> Iterator[str]:
    """The address of a stream whose patience is short."""
    with patch.dict(os.environ, {f"CAPHY_STREAM_{name}": value for name, value in STRICT.items()}):
        app = create_app(Settings(avatars=avatars))
    config = uvicorn.Config(app, port=0, log_level="warning", ws_per_message_deflate=False)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.02)
    yield f"ws://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}/avatars/shell/stream"
    server.should_exit = True
    thread.join(timeout=10)


@pytest.fixture
def address(url: str) -> str:
    return f"{url.replace('http', 'ws')}/avatars/shell/stream"


def opened(address: str, *first: bytes) -> ClientConnection:
    """A connection on which messages were sent, as far as the service let them; :func:`ending` tells why it ended."""
    found = connect(address, compression=None, max_size=None).__enter__()
    with suppress(ConnectionClosed):
        for message in first:
            found.send(message)
    return found


def ending(connection: ClientConnection, timeout: float = 10.0) -> tuple[int, str, list[bytes]]:
    """Close code and reason, and what was received before."""
    received: list[bytes] = []
    try:
        while True:
            received.append(connection.recv(timeout=timeout, decode=False))
    except ConnectionClosed as closed:
        assert closed.rcvd is not None, "the connection was not closed cleanly"
        return closed.rcvd.code, closed.rcvd.reason, received


def hello(**changes) -> bytes:
    return encode_client(Hello(**{"garments": (), "fps": 30.0, "credits": 8, **changes}))


def poses(number: int = 1, frames: int = 1) -> bytes:
    return encode_client(Poses(number, 0.0, np.zeros((frames, 55, 3)), np.zeros((frames, 3))))


def still_answers(address: str, motion) -> None:
    parts = urlsplit(address)
    with StreamClient(f"http://{parts.netloc}", "shell", patience=30) as stream:
        stream.send(motion.poses[0], motion.transl[0])
        assert np.isfinite(stream.receive().meshes.vertices["tshirt"]).all()


ENDINGS = [
    ([poses()], 4409, "hello"),
    ([hello(), hello()], 4409, "already"),
    ([b""], 4400, "24 bytes"),
    ([b"GET / HTTP/1.1\r\n" + bytes(20)], 4400, "CPHS"),
    ([hello(), b"CPHS\1\2" + bytes(18)], 4400, None),
    ([hello(), poses()[:-1]], 4400, "bytes"),
    ([hello(), b"CPHS\1\x81" + bytes(18)], 4400, "server's"),
    ([hello(), bytes(70_000)], 4413, "65536"),
    ([hello(garments=("hat",))], 4404, "hat"),
    ([hello(fps=0.0)], 4422, "fps"),
    ([hello(conditioning="calm")], 4422, "condition: must be on, off, or settings in JSON"),
    ([hello(conditioning="calm")[:-1] + b"\xff"], 4400, "must be UTF-8"),
]


@pytest.mark.parametrize(("sent", "code", "word"), ENDINGS)
def test_every_end_has_a_code_and_a_word(address, sent, code, word):
    if word is None:  # no poses at all: refused, and the stream goes on
        connection = opened(address, *sent, poses())
        connection.recv()
        failure = ServerDecoder(Encoding.FLOAT32, False).decode(connection.recv(decode=False))
        assert isinstance(failure, Failure)
        assert (failure.code, "at least one" in failure.text) == (422, True)
        connection.close()
        return
    found, reason, received = ending(opened(address, *sent))
    failure = ServerDecoder(Encoding.FLOAT32, False).decode(received[-1])
    assert isinstance(failure, Failure)
    assert (found, failure.code) == (code, code - 4000)
    assert word in failure.text
    assert failure.text.startswith(reason)


def test_text_and_unknown_avatars(address):
    connection = opened(address, hello())
    connection.send("poses, please")
    assert ending(connection)[:2] == (4400, "messages are binary, this one is text")
    code, reason, _ = ending(opened(address.replace("shell", "nobody"), hello()))
    assert (code, "nobody" in reason) == (4404, True)


def test_silence_is_ended(strict):
    assert ending(opened(strict))[:2] == (4408, "hello must come within 1 s")
    assert ending(opened(strict, hello()))[:2] == (4408, "nothing was heard for 3 s")


def test_one_client_has_so_many_streams(strict, motion):
    held = [opened(strict, hello()) for _ in range(STREAMS)]
    for connection in held:
        connection.recv()
    code, reason, _ = ending(opened(strict))  # without a hello: it may be closed before one could be sent
    assert (code, f"{STREAMS} streams" in reason) == (4429, True)
    for connection in held:
        connection.close()
    still_answers(strict, motion)


def mutated(body: bytes, rng: np.random.Generator) -> bytes:
    """The message with bytes flipped, cut, repeated or overwritten, seldom in its magic and version."""
    changed = bytearray(body)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(0 if rng.random() < 0.1 else 6, 40 if rng.random() < 0.5 else max(len(changed), 7)))
        match rng.integers(0, 5):
            case 0 if at < len(changed):
                changed[at] ^= 1 << int(rng.integers(0, 8))
            case 1:
                changed[at : at + 4] = rng.bytes(4)
            case 2 if rng.random() < 0.2:
                del changed[at : at + int(rng.integers(1, 64))]
            case 3 if rng.random() < 0.2:
                changed[at:at] = changed[at : at + 16]
            case 4:
                changed[at : at + 4] = rng.choice([b"\xff\xff\xff\xff", b"\0\0\xc0\x7f", b"\0\0\0\0", b"\0\0\x80\xff"])
    return bytes(changed)


def test_mutated_messages(address, motion, bundle):
    """Every stream ends with a code of ours or goes on; never 1011, which is an exception, and no log of one."""
    rng = np.random.default_rng(0)
    state = np.zeros(sum(garment.state_size for garment in bundle.garments), np.float32)
    hellos = [hello(), hello(garments=("tshirt",), encoding=Encoding.UINT16, normals=True), hello(state=state)]
    others = [encode_client(message) for message in (Credit(3), Reset(), Rate(60.0), GetState(1.0))]
    codes: Counter[int] = Counter()
    sent = 0
    while sent < MESSAGES:
        garbled = rng.random() < 0.2
        first = hellos[rng.integers(3)]
        connection = opened(address, mutated(first, rng) if garbled else first)
        sent += garbled
        try:
            for number in range(1, 25):
                choice = poses(number) if rng.random() < 0.5 else others[rng.integers(4)]
                connection.send(mutated(choice, rng))
                sent += 1
            connection.send(encode_client(Reset()) + b"!")  # ends it
        except ConnectionClosed:
            pass
        code, _, received = ending(connection)
        codes[code] += 1
        assert code in (4400, 4404, 4409, 4413, 4422), (code, received[-1])
    assert codes[4400] > 50
    still_answers(address, motion)


def test_mutated_messages_are_logged_as_nothing_of_ours(address, motion, caplog):
    rng = np.random.default_rng(1)
    for _ in range(20):
        ending(opened(address, hello(), *(mutated(poses(1), rng) for _ in range(3)), b"!"))
    assert not [record for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")]


def handshaken(address: str) -> socket.socket:
    """A bare socket after the upgrade, so that anything can be done to it."""
    parts = urlsplit(address)
    raw = socket.create_connection((parts.hostname or "", parts.port or 0))
    key = b64encode(bytes(16)).decode()
    raw.sendall(
        f"GET {parts.path} HTTP/1.1\r\nHost: {parts.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    answer = b""
    while b"\r\n\r\n" not in answer:
        answer += raw.recv(1)
    assert b" 101 " in answer
    return raw


def frame(body: bytes) -> bytes:
    """A masked binary frame; the mask is zero."""
    length = struct.pack("!B", 128 | len(body)) if len(body) < 126 else struct.pack("!BH", 254, len(body))
    return b"\x82" + length + bytes(4) + body


def test_abrupt_disconnects_at_any_byte(address, motion):
    rng = np.random.default_rng(2)
    whole = frame(hello()) + b"".join(frame(poses(number)) for number in range(1, 6))
    for _ in range(60):
        raw = handshaken(address)
        raw.sendall(whole[: int(rng.integers(len(whole)))])
        if rng.random() < 0.5:  # a reset instead of a goodbye
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        raw.close()
    still_answers(address, motion)


def test_nonsense_below_the_messages(address, motion):
    for nonsense in (b"\xff" * 100, b"\x82\xff" + b"\xff" * 8, b"\x81\x85" + bytes(4) + b"\xff" * 5, b"\x82\x05hello"):
        raw = handshaken(address)
        raw.sendall(frame(hello()) + nonsense)
        raw.settimeout(10)
        while raw.recv(65536):
            pass
        raw.close()
    still_answers(address, motion)


def test_half_open_connections_do_not_stay(strict, motion):
    """Peers that vanished without a word: after a while their places are free."""
    gone = [handshaken(strict) for _ in range(STREAMS)]
    for raw in gone:
        raw.sendall(frame(hello()))
    still_answers(strict, motion)
    for raw in gone:
        raw.close()


def test_readers_that_read_nothing_are_cut_off_and_memory_stays(strict, motion):
    """Each asks for far more meshes than the sockets hold; nobody takes them."""
    still_answers(strict, motion)
    before = resident_bytes()
    stuck = [handshaken(strict) for _ in range(STREAMS)]
    for raw in stuck:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        raw.setblocking(False)
        try:
            raw.send(frame(hello(credits=64)))
            for number in range(1, 2000, 32):
                raw.send(frame(poses(number, 32)) + frame(encode_client(Credit(64))))
        except BlockingIOError:
            pass
    asked = STREAMS * 2000 * 12 * 3000  # bytes, roughly
    still_answers(strict, motion)  # when a place is free: the first was cut off
    grown = resident_bytes() - before
    assert grown < 80e6 < asked / 5
    still_answers(strict, motion)
    for raw in stuck:
        raw.close()
