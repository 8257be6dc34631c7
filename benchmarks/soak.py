"""Full load for a while: clients that stream, clients that vanish, clients that talk nonsense; memory must stay.

python -m benchmarks.soak --seconds 600 --workers 2
"""

from __future__ import annotations

import random
import re
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from http.client import HTTPConnection, HTTPException
from urllib.request import urlopen

import numpy as np
import tyro

from caphy.io.poses import PoseSequence
from caphy.io.procedural import procedural_motion
from service.protocol import MEDIA_TYPE, FramesRequest, decode_response, encode_request


@dataclass(frozen=True)
class Soak:
    """Serve the default avatar and put it under full load."""

    seconds: float = 60.0
    """How long [s]."""
    workers: int = 1
    """Processes of the service."""
    clients: int = 4
    """Clients that stream frames, each as fast as it is answered; two more make trouble."""


@dataclass
class Seen:
    """Answers by status, frames, connections that broke, the whole time [s], and memory [bytes] over time [s]."""

    statuses: Counter[int] = field(default_factory=Counter)
    frames: int = 0
    broken: int = 0
    seconds: float = 0.0
    memory: list[tuple[float, float]] = field(default_factory=list)

    def growth(self) -> float:
        """Bytes by which the median of the last third of the memory is above that of the second."""
        values = np.array([value for _, value in self.memory])
        third = len(values) // 3
        return float(np.median(values[2 * third :]) - np.median(values[third : 2 * third]))


def soak(url: str, avatar: str, seconds: float, clients: int) -> Seen:
    """What was seen of the service at ``url`` under full load."""
    seen, over = Seen(), threading.Event()
    port = int(url.rpartition(":")[2])
    works: list[Callable[[], None]] = [lambda seed=seed: _stream(port, avatar, seed, seen) for seed in range(clients)]
    works += [lambda: _vanish(port, avatar, seen), lambda: _nonsense(port, avatar, seen)]
    threads = [threading.Thread(target=_repeat, args=(work, over, seen), daemon=True) for work in works]
    for thread in threads:
        thread.start()
    started = time.monotonic()
    while (elapsed := time.monotonic() - started) < seconds:
        seen.memory.append((elapsed, resident_bytes(url)))
        time.sleep(min(1.0, seconds / 30))
    over.set()
    for thread in threads:
        thread.join(timeout=60)
    seen.seconds = time.monotonic() - started
    return seen


def resident_bytes(url: str) -> float:
    """Memory of all the service's processes."""
    with urlopen(url + "/metrics", timeout=30) as answer:
        return float(re.findall(r"^caphy_resident_bytes (\S+)", answer.read().decode(), re.MULTILINE)[0])


def _repeat(work: Callable[[], None], over: threading.Event, seen: Seen) -> None:
    while not over.is_set():
        try:
            work()
        except (OSError, HTTPException):
            seen.broken += 1


def _post(connection: HTTPConnection, avatar: str, body: bytes, seen: Seen) -> bytes | None:
    connection.request("POST", f"/avatars/{avatar}/frames", body, {"content-type": MEDIA_TYPE})
    response = connection.getresponse()
    content = response.read()
    seen.statuses[response.status] += 1
    return content if response.status == 200 else None


def _stream(port: int, avatar: str, seed: int, seen: Seen) -> None:
    """A hundred frames one by one with their state, then a second of motion at once."""
    motion, state = _motion(seed), np.zeros(0)
    connection = HTTPConnection("127.0.0.1", port, timeout=30)
    for frame in range(100):
        part = slice(frame, frame + 1)
        content = _post(connection, avatar, _body(motion.poses[part], motion.transl[part], state), seen)
        if content is not None:
            state = np.concatenate(list(decode_response(content).states.values()))
            seen.frames += 1
    _post(connection, avatar, _body(motion.poses[:30], motion.transl[:30], np.zeros(0)), seen)
    connection.close()


@cache
def _motion(seed: int) -> PoseSequence:
    return procedural_motion(seed=seed, seconds=4)


def _body(poses: np.ndarray, transl: np.ndarray, state: np.ndarray) -> bytes:
    return encode_request(FramesRequest(poses, transl, 30.0, state))


def _vanish(port: int, avatar: str, seen: Seen) -> None:
    """Send a part of a request, or all of it, and be gone."""
    body = _body(np.zeros((60, 55, 3)), np.zeros((60, 3)), np.zeros(0))
    head = f"POST /avatars/{avatar}/frames HTTP/1.1\r\nhost: x\r\ncontent-type: {MEDIA_TYPE}\r\n"
    whole = f"{head}content-length: {len(body)}\r\n\r\n".encode() + body
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(whole[: random.randint(1, len(whole))])
        if random.random() < 0.5:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    time.sleep(0.02)


def _nonsense(port: int, avatar: str, seen: Seen) -> None:
    """Twenty requests of random bytes."""
    connection = HTTPConnection("127.0.0.1", port, timeout=30)
    for _ in range(20):
        _post(connection, avatar, b"CPHQ" * (random.random() < 0.5) + random.randbytes(random.randint(0, 3000)), seen)
    connection.close()
    time.sleep(0.02)


def main() -> None:
    """Serve, soak, print."""
    command = tyro.cli(Soak)
    serve = [sys.executable, "-m", "caphy.cli", "serve", "--port", "0", "--workers", str(command.workers)]
    process = subprocess.Popen(serve, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    try:
        url = process.stdout.readline().split()[3]
        print(f"{command.clients} clients that stream and two that make trouble, {command.workers} worker(s)")
        seen = soak(url, "default", command.seconds, command.clients)
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=30)
    answers = ", ".join(f"{count} x {status}" for status, count in sorted(seen.statuses.items()))
    print(f"answers: {answers}; connections broken: {seen.broken}; {seen.frames / seen.seconds:.0f} frames/s")
    for elapsed, value in seen.memory[:: max(1, len(seen.memory) // 10)]:
        print(f"{elapsed:8.0f} s {value / 1e6:8.1f} MB")
    print(f"growth from the second third to the last: {seen.growth() / 1e6:+.1f} MB")


if __name__ == "__main__":
    main()
