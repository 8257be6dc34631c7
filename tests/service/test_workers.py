"""Several processes on one port: shared work, shared numbers, and a kill -9 that loses nothing."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from live_service import LiveService, live_service, wait_until
from shell_avatar import wiggle
from test_app import body_of

from caphy.cli import main
from caphy.errors import CaphyError
from service.client import Client
from service.engine import GarmentEngine
from service.protocol import decode_response
from service.workers import _metrics_folder

STREAMS = 6
FRAMES = 90


@pytest.fixture(scope="module")
def pair(avatars) -> Iterator[LiveService]:
    with live_service(avatars, "--workers", "2") as service:
        wait_until(lambda: service.count("ready") == 2)
        yield service


def test_it_says_what_starting_took(pair):
    assert "with 2 workers" in pair.said[0]
    assert re.fullmatch(r"cold start \d+\.\d s; memory of the process \d+ MB\n", pair.said[1])
    assert re.fullmatch(r"  avatar shell: loaded and warm in \d+\.\d s, \d+ MB\n", pair.said[2])


def stream(url: str, seed: int, killed: threading.Event, found: dict[int, np.ndarray], retries: list[int]) -> None:
    """Send a motion frame by frame with its state; where the connection breaks, send the same frame again."""
    motion, states, meshes = wiggle(FRAMES / 30, seed=seed), None, []
    client = Client(url)
    for frame in range(FRAMES):
        if frame == 2 * FRAMES // 3:
            assert killed.wait(60)
        for attempt in range(50):
            try:
                answer = client.run("shell", motion[frame : frame + 1], ["tshirt"], states)
                break
            except CaphyError as error:
                assert "cannot be reached" in str(error)  # not one request is answered wrongly
                retries.append(attempt)
                time.sleep(0.05)
        states = answer.states
        meshes.append(answer.vertices["tshirt"][0])
    client.close()
    found[seed] = np.stack(meshes)


def test_killing_a_worker_loses_nothing(pair, bundle):
    """Clients keep the state, so any worker continues their motion."""
    before = pair.workers()
    assert len(before) == 2
    found: dict[int, np.ndarray] = {}
    retries: list[int] = []
    killed = threading.Event()
    clients = [threading.Thread(target=stream, args=(pair.url, s, killed, found, retries)) for s in range(STREAMS)]
    for client in clients:
        client.start()
    wait_until(lambda: pair.number("caphy_frames_total") > STREAMS * FRAMES / 4)
    os.kill(before[0], signal.SIGKILL)
    killed.set()
    for client in clients:
        client.join(timeout=60)
    engine = GarmentEngine(bundle.garment("tshirt"))
    for seed in range(STREAMS):
        motion = wiggle(FRAMES / 30, seed=seed)
        arrays = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
        expected, _ = engine.run(*arrays, engine.initial_state())
        np.testing.assert_allclose(found[seed], expected, atol=5e-6)
    wait_until(lambda: len(pair.workers()) == 2)
    assert before[0] not in pair.workers()
    assert before[1] in pair.workers()
    wait_until(lambda: pair.count("ready") == 3)
    assert pair.number("caphy_avatar_loads_total") == 3  # what the dead one counted is kept
    (death,) = [line for line in pair.logged() if "died" in line["message"]]
    assert (death["pid"], death["status"]) == (before[0], -9)


def test_numbers_are_those_of_all_workers(pair):
    before = pair.number("caphy_requests_total")
    for _ in range(20):  # a new connection each, so both answer some
        urlopen(pair.url + "/health", timeout=10).read()
    assert pair.number("caphy_requests_total") - before >= 20
    assert pair.number("caphy_resident_bytes") > 5e7
    assert pair.number("caphy_inference_in_flight") == 0


def test_connections_are_shared(avatars, pair):
    """Neither worker takes everything of a burst; asyncio alone would let the first accept all that wait.

    A busy machine may keep one of them from running for as long as a burst takes, but not three times.
    """
    assert max(min(_burst(pair)) for _ in range(3)) >= 4


def _burst(pair: LiveService) -> list[int]:
    """How many of 40 connections opened at once each worker takes."""
    held = [HTTPConnection("127.0.0.1", pair.port, timeout=10) for _ in range(40)]
    for connection in held:
        connection.connect()
    for connection in held:
        connection.request("GET", "/health")
    for connection in held:
        assert connection.getresponse().read()
    counts = [connections_of(pid, pair.port) for pid in pair.workers()]
    for connection in held:
        connection.close()
    assert sum(counts) >= 40
    return counts


def connections_of(pid: int, port: int) -> int:
    """Established connections of a process to a local port, as the kernel lists them."""
    with open(f"/proc/{pid}/net/tcp") as table:
        rows = [line.split() for line in table.readlines()[1:]]
    inodes = {f"socket:[{row[9]}]" for row in rows if row[3] == "01" and row[1].endswith(f":{port:04X}")}
    files = [os.readlink(f"/proc/{pid}/fd/{name}") for name in os.listdir(f"/proc/{pid}/fd") if name.isdigit()]
    return sum(name in inodes for name in files)


def test_stopping_finishes_what_is_in_flight(avatars, motion):
    body = body_of(motion)
    with live_service(avatars, "--workers", "2") as service:
        wait_until(lambda: service.count("ready") == 2)
        connection = HTTPConnection("127.0.0.1", service.port, timeout=20)
        connection.putrequest("POST", "/avatars/shell/frames")
        connection.putheader("content-type", "application/octet-stream")
        connection.putheader("content-length", str(len(body)))
        connection.endheaders(body[:1000])
        wait_until(lambda: service.number("caphy_buffered_bytes") == 1000)
        service.process.send_signal(signal.SIGTERM)
        wait_until(lambda: service.count("stopping") == 2)
        with pytest.raises(OSError):  # nothing new is begun
            socket.create_connection(("127.0.0.1", service.port), timeout=5)
        connection.send(body[1000:])
        answer = decode_response(connection.getresponse().read())
        assert len(answer.vertices["tshirt"]) == len(motion)
        assert service.process.wait(timeout=20) == 0


def test_told_to_stop_before_it_is_ready_it_ends_well(avatars):
    command = [sys.executable, "-m", "caphy.cli", "serve", "--avatars", str(avatars), "--port", "0", "--workers", "2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        wait_until(lambda: children.read_text().strip())  # its handlers are set before it starts the first worker
        process.send_signal(signal.SIGTERM)
        said, complaints = process.communicate(timeout=20)
    assert process.returncode == 0, complaints
    assert said == ""


def test_workers_end_with_their_parent(avatars):
    with live_service(avatars, "--workers", "2") as service:
        wait_until(lambda: service.count("ready") == 2)
        workers = service.workers()
        service.process.kill()
        service.process.wait()
        wait_until(lambda: not any(os.path.exists(f"/proc/{pid}/exe") and running(pid) for pid in workers))


def test_what_a_killed_service_leaves_in_memory_goes_when_the_next_one_starts():
    killed, lock = _metrics_folder()
    alive, held = _metrics_folder()
    assert killed.is_dir()  # as long as its process lives
    os.close(lock)  # as a kill -9 does
    new, other = _metrics_folder()
    try:
        assert not killed.exists()
        assert alive.is_dir() and new.is_dir()
    finally:
        for folder, descriptor in ((alive, held), (new, other)):
            folder.rmdir()
            os.close(descriptor)


def running(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as status:
            return status.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_first_worker_that_cannot_start_ends_it_all(tmp_path, capfd):
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "avatar.json").write_text("{}")
    assert main(["serve", "--workers", "2", "--port", "0", "--avatars", str(tmp_path)]) == 2
    said = capfd.readouterr().err
    assert "must be of schema" in said
    assert "Traceback" not in said
