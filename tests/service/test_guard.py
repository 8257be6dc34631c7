"""Limits of one process: who is refused, how, and that the service recovers."""

from __future__ import annotations

import gzip
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import anyio
import pytest
from fastapi.testclient import TestClient
from test_app import BINARY, FRAMES, body_of, refused, still

from caphy.io.poses import write_poses
from service import frames, guard
from service.app import create_app
from service.errors import Problem
from service.guard import Guard, Hold
from service.metrics import Metrics
from service.settings import Settings


@contextmanager
def service(avatars, **limits) -> Iterator[TestClient]:
    with TestClient(create_app(Settings(avatars=avatars, **limits))) as client:
        yield client


@pytest.fixture
def gate(monkeypatch) -> Iterator[threading.Event]:
    """Inference waits until the event is set."""
    opened = threading.Event()
    answer = frames.answer

    def waiting(*arguments):
        assert opened.wait(20)
        return answer(*arguments)

    monkeypatch.setattr("service.frames.answer", waiting)
    yield opened
    opened.set()


def wait_for(condition) -> None:
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def in_flight(client: TestClient) -> float:
    return client.app.state.metrics.in_flight._value.get()


def test_overload_is_refused_at_once_and_the_service_recovers(avatars, motion, gate):
    body = body_of(motion[:1])
    with service(avatars, threads=1, max_waiting=2) as client, ThreadPoolExecutor(3) as pool:
        taken = [pool.submit(client.post, FRAMES, content=body, headers=BINARY) for _ in range(3)]
        wait_for(lambda: in_flight(client) == 3)
        response = client.post(FRAMES, content=body, headers=BINARY)
        refused(response, 503, "limit")
        assert response.headers["retry-after"] == "1"
        response = client.post("/v2/models/shell.tshirt/infer", content=b"{}")
        assert response.status_code == 503
        assert "limit" in response.json()["error"]
        assert client.get("/ready").status_code == 200  # a busy process is not a dead one
        gate.set()
        assert [future.result().status_code for future in taken] == [200, 200, 200]
        assert client.post(FRAMES, content=body, headers=BINARY).status_code == 200
        assert in_flight(client) == 0
        assert b'caphy_refused_total{reason="overload"} 2.0' in client.get("/metrics").content


def test_who_waits_too_long_is_refused(avatars, motion, gate):
    body = body_of(motion[:1])
    with service(avatars, threads=1, max_wait_seconds=0.05) as client, ThreadPoolExecutor(1) as pool:
        first = pool.submit(client.post, FRAMES, content=body, headers=BINARY)
        wait_for(lambda: in_flight(client) == 1)
        response = client.post(FRAMES, content=body, headers=BINARY)
        refused(response, 503, "waited for 0.05 s")
        assert response.headers["retry-after"] == "1"
        gate.set()
        assert first.result().status_code == 200
        assert client.post(FRAMES, content=body, headers=BINARY).status_code == 200


def test_one_client_has_so_many_requests_at_once(avatars, motion, gate):
    body = body_of(motion[:1])
    with service(avatars, threads=1, max_client_requests=2) as client, ThreadPoolExecutor(2) as pool:
        taken = [pool.submit(client.post, FRAMES, content=body, headers=BINARY) for _ in range(2)]
        wait_for(lambda: in_flight(client) == 2)
        refused(client.post(FRAMES, content=body, headers=BINARY), 429, "2 requests")
        gate.set()
        assert [future.result().status_code for future in taken] == [200, 200]
        assert client.post(FRAMES, content=body, headers=BINARY).status_code == 200


def test_one_client_has_so_many_requests_per_second(avatars):
    with service(avatars, max_client_rate=5) as client:
        answers = Counter(client.get("/avatars").status_code for _ in range(20))
        assert answers[429] > 0
        assert answers[200] >= 5
        refused(client.get("/avatars"), 429, "5 requests per second")
        assert client.get("/ready").status_code == 200
        time.sleep(1.1)
        assert client.get("/avatars").status_code == 200


def test_less_than_a_request_per_second_is_one_now_and_then(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(guard, "monotonic", lambda: clock[0])
    guarded = Guard(Settings(max_client_rate=0.25), Metrics())
    passed, after = [], []
    for clock[0] in range(12):
        try:
            guarded.count_request(guarded.client("192.0.2.1"))
            passed.append(clock[0])
        except Problem as refused:
            after.append(refused.headers["retry-after"])
    assert passed == [0, 4, 8]
    assert after == ["3", "2", "1"] * 3


def test_other_clients_are_not_held_back():
    guarded = Guard(Settings(max_client_rate=1), Metrics())
    guarded.count_request(guarded.client("192.0.2.1"))
    with pytest.raises(Problem, match="per second"):
        guarded.count_request(guarded.client("192.0.2.1"))
    guarded.count_request(guarded.client("192.0.2.2"))


def test_clients_are_forgotten(monkeypatch):
    monkeypatch.setattr(guard, "KNOWN_CLIENTS", 10)
    guarded = Guard(Settings(), Metrics())
    first = guarded.client("first")
    for number in range(50):
        guarded.client(str(number))
        assert guarded.client("first") is first  # it keeps asking
    assert len(guarded._clients) == 10


def test_bytes_held_are_bounded_and_given_back(avatars, motion):
    with service(avatars, max_buffered_bytes=1 << 20) as client:
        refused(client.post(FRAMES, content=still(1000), headers=BINARY), 413, "fewer frames")
        for _ in range(5):
            assert client.post(FRAMES, content=body_of(motion[:8]), headers=BINARY).status_code == 200
        assert client.app.state.guard._buffered == 0


GET_ANSWERS = ["/avatars/shell/mesh", "/avatars/shell/mesh?format=glb", "/avatars/shell/poses"]


@pytest.mark.parametrize("path", GET_ANSWERS)
def test_answers_without_a_body_to_read_are_held_too(avatars, path):
    with service(avatars, max_client_requests=1) as client:
        state = client.app.state
        size = len(client.get(path).content)
        assert state.guard._buffered == 0
        state.guard.buffer(state.settings.max_buffered_bytes - size + 1)
        refused(client.get(path), 503, "as many bytes")
        state.guard.buffer(-1)
        assert len(client.get(path).content) == size
        state.guard.client("testclient").requests += 1
        refused(client.get(path), 429, "1 requests")
        state.settings.max_buffered_bytes = size - 1
        state.guard.client("testclient").requests -= 1
        refused(client.get(path), 413, str(size))


def test_poses_of_a_file_are_held_until_they_are_sent(avatars, motion, tmp_path):
    write_poses(motion, tmp_path / "motion.npz")
    file = (tmp_path / "motion.npz").read_bytes()
    with service(avatars) as client:

        def sent():
            return client.post("/avatars/shell/poses", params={"name": "motion.npz"}, content=file, headers=BINARY)

        size = len(sent().content)
        state = client.app.state
        state.guard.buffer(state.settings.max_buffered_bytes - len(file) - size + 1)
        refused(sent(), 503, "as many bytes")
        state.guard.buffer(-1)
        assert len(sent().content) == size


def test_many_small_holds_fill_the_service_too():
    guarded = Guard(Settings(max_buffered_bytes=1024), Metrics())
    holds = [Hold(guarded, guarded.client(str(number))) for number in range(4)]
    for hold in holds[:3]:
        hold.reserve(300)
    with pytest.raises(Problem, match="as many bytes") as found:
        holds[3].reserve(300)
    assert found.value.status == 503
    holds[0].release()
    holds[3].reserve(300)
    for hold in holds:
        hold.release()
    assert guarded._buffered == 0


@pytest.mark.parametrize("encoding", ["gzip", "deflate", "br", "zstd", "gzip, gzip", "x"])
def test_compressed_bodies_are_refused(http, motion, encoding):
    bomb = gzip.compress(bytes(4 << 20))
    response = http.post(FRAMES, content=bomb, headers={**BINARY, "content-encoding": encoding})
    refused(response, 415, "not be compressed")
    assert response.headers["accept-encoding"] == "identity"


def test_slow_bodies_are_refused(avatars):
    async def trickle():
        for _ in range(100):
            await anyio.sleep(0.02)
            yield {"type": "http.request", "body": b"x", "more_body": True}

    app = create_app(Settings(avatars=avatars, body_seconds=0.2))
    app.state.library.load()
    sent: list[dict] = []
    messages = trickle()
    headers = [(b"content-type", b"application/octet-stream")]
    scope = {"type": "http", "method": "POST", "path": FRAMES, "query_string": b"", "headers": headers}

    async def call():
        async def send(message):
            sent.append(message)

        await app(scope, messages.__anext__, send)

    anyio.run(call)
    assert sent[0]["status"] == 408
    assert app.state.guard._buffered == 0


@pytest.mark.parametrize(("method", "path"), [("POST", FRAMES), ("GET", "/avatars/shell/mesh")])
def test_slow_readers_are_dropped(avatars, motion, method, path, monkeypatch):
    monkeypatch.setattr("service.answers.PIECE", 1024)
    app = create_app(Settings(avatars=avatars, send_seconds=0.2))
    app.state.library.load()
    sent: list[dict] = []
    headers = [(b"content-type", b"application/octet-stream")]
    scope = {"type": "http", "method": method, "path": path, "query_string": b"", "headers": headers}

    async def receive():
        return {"type": "http.request", "body": body_of(motion), "more_body": False}

    async def send(message):
        sent.append(message)
        if len(sent) == 3:
            await anyio.sleep(30)

    anyio.run(app, scope, receive, send)
    assert sent[0]["status"] == 200
    assert sent[-1]["more_body"]  # the answer never came to its end
    assert app.state.guard._buffered == 0
    assert b'reason="slow_reader"} 1.0' in app.state.metrics.exposition()


def test_the_gauge_moves_under_load(avatars, motion, gate):
    """What an autoscaler watches."""
    body = body_of(motion[:1])

    def shown(client: TestClient) -> float:
        lines = client.get("/metrics").text.splitlines()
        return float(next(line for line in lines if line.startswith("caphy_inference_in_flight ")).split()[1])

    with service(avatars, threads=2) as client, ThreadPoolExecutor(6) as pool:
        assert shown(client) == 0
        for count in (2, 6):
            taken = [pool.submit(client.post, FRAMES, content=body, headers=BINARY) for _ in range(count)]
            wait_for(lambda expected=count: shown(client) == expected)
            gate.set()
            assert {future.result().status_code for future in taken} == {200}
            gate.clear()
            assert shown(client) == 0
