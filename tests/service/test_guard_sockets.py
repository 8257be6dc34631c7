"""Clients that are slow, vanish or talk nonsense, against a real process: it stays well and answers others."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
import pytest
from live_service import LiveService, live_service, wait_until
from shell_avatar import wiggle
from test_app import FRAMES, body_of

from service.client import Client

LIMITS = {
    "CAPHY_HEADER_SECONDS": "1",
    "CAPHY_BODY_SECONDS": "1",
    "CAPHY_SEND_SECONDS": "2",
    "CAPHY_MAX_CONNECTIONS": "60",
}
HEAD = f"POST {FRAMES} HTTP/1.1\r\nhost: x\r\ncontent-type: application/octet-stream\r\n"


@pytest.fixture(scope="module")
def service(avatars) -> Iterator[LiveService]:
    with live_service(avatars, **LIMITS) as found:
        yield found
        assert found.stop() == 0
        assert [line.get("traceback") for line in found.logged() if "traceback" in line] == []


@pytest.fixture(autouse=True)
def well_afterwards(service, motion) -> Iterator[None]:
    """After every test the service answers, and holds nothing."""
    yield
    assert len(Client(service.url).frames("shell", motion[:3])["tshirt"]) == 3
    wait_until(lambda: service.number("caphy_buffered_bytes") == 0)
    assert service.number("caphy_inference_in_flight") == 0


def connect(service: LiveService, receive_buffer: int = 0) -> socket.socket:
    found = socket.socket()
    if receive_buffer:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    found.settimeout(10)
    found.connect(("127.0.0.1", service.port))
    return found


def rest_of(connection: socket.socket) -> bytes:
    """Everything until the other side closes, in order or not."""
    found = b""
    with suppress(ConnectionResetError):
        while part := connection.recv(1 << 16):
            found += part
    return found


def test_slow_loris_headers_are_cut_off(service):
    slow = [connect(service) for _ in range(20)]
    started = time.monotonic()
    for number, connection in enumerate(slow):  # nothing at all, a part of a header, a header that never ends
        connection.sendall([b"", HEAD.encode()[:30], HEAD.encode()][number % 3])
    Client(service.url).avatars()  # others are served meanwhile
    assert [rest_of(connection) for connection in slow] == [b""] * 20
    assert time.monotonic() - started < 8


def test_dripping_does_not_help(service):
    connection = connect(service)
    connection.sendall(HEAD.encode())
    with pytest.raises(OSError):  # a byte more now and then does not keep it open
        for _ in range(100):
            connection.sendall(b"a")
            time.sleep(0.05)
    connection.close()


def test_a_slow_second_request_is_cut_off_too(service):
    connection = connect(service)
    connection.sendall(b"GET /health HTTP/1.1\r\nhost: x\r\n\r\n")
    answer = b""
    while not answer.endswith(b"}"):  # head and body may come apart
        part = connection.recv(4096)
        assert part, "closed too early"
        answer += part
    assert b"200 OK" in answer
    connection.sendall(b"GET /hea")
    assert rest_of(connection) == b""


def test_slow_bodies_get_408(service, motion):
    body = body_of(motion)
    slow = [connect(service) for _ in range(8)]
    for connection in slow:
        connection.sendall(f"{HEAD}content-length: {len(body)}\r\n\r\n".encode() + body[:5000])
    assert len(Client(service.url).frames("shell", motion[:3])["tshirt"]) == 3
    for connection in slow:
        answer = rest_of(connection)
        assert answer.startswith(b"HTTP/1.1 408")
        assert b"within 1 s" in answer


def test_clients_that_vanish(service, motion):
    """In the header, in the body, before and while the answer comes; politely and by a reset."""
    body = body_of(motion)
    whole = f"{HEAD}content-length: {len(body)}\r\n\r\n".encode() + body
    rng = np.random.default_rng(0)
    for number in range(60):
        connection = connect(service)
        connection.sendall(whole[: int(rng.integers(1, len(whole) + 1))] if number % 3 else whole)
        if number % 2:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        if number % 5 == 0:
            connection.recv(10)
        connection.close()


def test_half_closed_sockets(service, motion):
    """A client that sends its request and closes its writing side still gets the answer, or the connection's end."""
    body = body_of(motion[:2])
    connection = connect(service)
    connection.sendall(f"{HEAD}content-length: {len(body)}\r\nconnection: close\r\n\r\n".encode() + body)
    connection.shutdown(socket.SHUT_WR)
    answer = rest_of(connection)
    assert answer == b"" or answer.startswith(b"HTTP/1.1 200")
    connection = connect(service)
    connection.shutdown(socket.SHUT_WR)
    assert rest_of(connection) == b""


def test_readers_that_do_not_read_are_dropped(service):
    """Answers of many megabytes to clients that take none of them."""
    motion = wiggle(12, seed=5)
    body = body_of(motion)
    slow = [connect(service, receive_buffer=4096) for _ in range(4)]
    for connection in slow:
        connection.sendall(f"{HEAD}content-length: {len(body)}\r\n\r\n".encode() + body)
    wait_until(lambda: service.number("caphy_buffered_bytes") > 1e7)
    assert len(Client(service.url).frames("shell", motion[:3])["tshirt"]) == 3
    wait_until(lambda: service.number("caphy_buffered_bytes") == 0)
    assert service.number("caphy_refused_total") >= 4
    for connection in slow:
        connection.close()


def test_too_many_connections_are_told(service):
    held = [connect(service) for _ in range(60)]
    refused = connect(service)
    answer = rest_of(refused)
    assert answer.startswith(b"HTTP/1.1 503")
    assert b"retry-after: 1" in answer
    for connection in held:
        connection.close()


NONSENSE = [
    b"\0" * 64,
    b"GET /nothing HTTP/9.9\r\nconnection: close\r\n\r\n",
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # a TLS hello
    b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    HEAD.encode() + b"content-length: -1\r\n\r\n",
    HEAD.encode() + b"content-length: 99999999999999999999\r\n\r\n",
    HEAD.encode() + b"transfer-encoding: chunked\r\n\r\nzz\r\n",
    HEAD.encode() + b"content-length: 5\r\ntransfer-encoding: chunked\r\nconnection: close\r\n\r\n0\r\n\r\n",
    b"GET /" + b"a" * 200_000,
    HEAD.encode() + b"x: y\r\n" * 50_000,
    b"GET /avatars/%00%ff HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n",
    b"GET /avatars HTTP/1.1\r\nhost: x\r\nupgrade: websocket\r\nconnection: upgrade\r\n\r\n",
    b"GET /avatars/shell/stream HTTP/1.1\r\nhost: x\r\nupgrade: websocket\r\nconnection: upgrade\r\n\r\n",
]


@pytest.mark.parametrize("sent", NONSENSE, ids=range(len(NONSENSE)))
def test_nonsense_is_refused_or_cut_off(service, sent):
    connection = connect(service)
    with suppress(OSError):  # cut off while it was still talking
        connection.sendall(sent)
    answer = rest_of(connection)
    assert answer == b"" or answer.startswith(b"HTTP/1.1 4"), answer[:100]
    connection.close()
