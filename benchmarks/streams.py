"""How many live streams a few server processes hold: 30 poses a second each, two garments answered, on loopback.

python -m benchmarks.streams [--seconds 10] [--processes 2] [--encoding uint16]

Held means that the 99th percentile of the time from a pose's departure to the last byte of its meshes is below one
frame at 30 fps, and that every pose is answered. Before that it prints what a stream's frame costs in the process that
computes it, sockets left out, as streams are computed one by one and together: in processor time, so that it may be
compared on a busy machine too. The clients run in a process of their own on the same cores as the
servers, and share them: they speak just as much WebSocket as they must.
"""

from __future__ import annotations

import asyncio
import json
import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import get_context

import numpy as np
import tyro

from caphy.io.procedural import procedural_motion
from service.avatars import Avatar, load_avatar
from service.encodings import Encoding, EncodingName
from service.engine import STREAMS
from service.metrics import Metrics, Stages
from service.settings import BUNDLED_AVATARS, Settings
from service.stream.limits import StreamLimits
from service.stream.messages import Credit, Hello, Kind, Poses, decode_client, encode_client
from service.stream.scheduler import Member, advance
from service.stream.session import Session

FPS = 30.0
DEADLINE_MS = 1e3 / FPS
WARM_UP = 1.5
"""Seconds before anything is counted."""
HELD = 0.999
"""Least share of poses answered."""


@dataclass(frozen=True)
class Arguments:
    """How long, by how many processes, and packed how."""

    seconds: float = 10.0
    """Length of each trial [s]."""
    processes: int = 2
    """Server processes, one port each; each computes on one thread."""
    encoding: EncodingName = "uint16"
    """How meshes are packed."""
    most: int = 200
    """Streams beyond which nothing is tried."""


@dataclass
class Stream(asyncio.Protocol):
    """A client that does nothing but send poses on time and take meshes; the least a client can be."""

    encoding: str
    messages: list[bytes]
    waits: list[tuple[float, float]] = field(default_factory=list)
    """When a pose left, and how long its meshes took [s]."""
    sent: int = 0
    lost: bool = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport: asyncio.Transport = transport  # type: ignore[assignment]
        self._buffer = bytearray()
        self._need = 0
        self._upgraded = False
        self._taken = 0
        self.welcomed = asyncio.Event()
        transport.write(  # type: ignore[attr-defined]
            b"GET /avatars/default/stream HTTP/1.1\r\nHost: bench\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost = True

    def write(self, body: bytes) -> None:
        """One binary frame under a mask of zeros."""
        head = struct.pack("!BB", 130, 128 | len(body)) if len(body) < 126 else struct.pack("!BBH", 130, 254, len(body))
        self._transport.write(head + bytes(4) + body)

    def data_received(self, data: bytes) -> None:
        self._buffer += data
        if not self._upgraded:
            end = self._buffer.find(b"\r\n\r\n")
            if end < 0:
                return
            if b" 101 " not in self._buffer[:20]:
                raise RuntimeError(self._buffer.decode(errors="replace"))
            del self._buffer[: end + 4]
            self._upgraded = True
            self.write(encode_client(Hello((), FPS, Encoding[self.encoding.upper()], credits=64)))
        while len(self._buffer) >= max(2, self._need):
            short = self._buffer[1] & 127
            start = 2 + {126: 2, 127: 8}.get(short, 0)
            if len(self._buffer) < start:
                return
            length = short if short < 126 else int.from_bytes(self._buffer[2:start], "big")
            self._need = start + length
            if len(self._buffer) < self._need:
                return
            self._message(self._buffer[start : start + 24])
            del self._buffer[: self._need]
            self._need = 0

    def _message(self, header: bytearray) -> None:
        kind = header[5]
        if kind == Kind.MESHES:
            (left,) = struct.unpack_from("<d", header, 16)
            self.waits.append((left, time.perf_counter() - left))
            self._taken += 1
            if self._taken % 16 == 0:
                self.write(encode_client(Credit(16)))
        elif kind == Kind.WELCOME:
            self.welcomed.set()
        elif kind == Kind.ERROR:
            raise RuntimeError("the service refused a benchmark's stream")

    async def run(self, offset: float, end: float) -> None:
        """Send a pose every frame from ``offset`` [s] on."""
        await asyncio.wait_for(self.welcomed.wait(), 30)
        start = time.perf_counter() + offset
        while not self.lost:
            at = start + self.sent / FPS
            if at > end:
                return
            await asyncio.sleep(max(0.0, at - time.perf_counter()))
            body = bytearray(self.messages[self.sent % len(self.messages)])
            struct.pack_into("<Id", body, 8, self.sent + 1, 0.0)
            struct.pack_into("<d", body, 16, time.perf_counter())
            self.write(bytes(body))
            self.sent += 1


def trial(ports: list[int], streams: int, encoding: str, seconds: float) -> dict[str, float]:
    """Percentiles of the waits [ms], the share of poses answered, and the clients' processor time."""
    motion = procedural_motion(seed=3, seconds=4.0)
    messages = [
        encode_client(Poses(1, 0.0, motion.poses[i : i + 1], motion.transl[i : i + 1])) for i in range(len(motion))
    ]

    async def run() -> list[Stream]:
        loop = asyncio.get_running_loop()
        clients = []
        for i in range(streams):
            port = ports[i % len(ports)]
            _, client = await loop.create_connection(lambda: Stream(encoding, messages), "127.0.0.1", port)
            clients.append(client)
        end = time.perf_counter() + WARM_UP + seconds
        await asyncio.gather(*(client.run(i / streams / FPS, end) for i, client in enumerate(clients)))
        await asyncio.sleep(0.2)
        return clients

    used, counted_from = time.process_time(), time.perf_counter() + WARM_UP
    clients = asyncio.run(run())
    used = time.process_time() - used
    waits = 1e3 * np.array(
        [wait for client in clients for left, wait in client.waits if left >= counted_from] or [np.inf]
    )
    answered = sum(len(client.waits) for client in clients) / max(1, sum(client.sent for client in clients))
    if any(client.lost for client in clients):
        answered = 0.0
    p50, p99 = (float(value) for value in np.percentile(waits, [50, 99], method="lower"))
    return {"p50": p50, "p99": p99, "answered": answered, "client_cpu": used / (seconds + WARM_UP)}


def cost(streams: int, encoding: str, turns: int) -> float:
    """Processor milliseconds per frame of so many streams: poses read, two garments computed, meshes packed."""
    motion, stages = procedural_motion(seed=3, seconds=4.0), Stages(Metrics().stream_seconds)
    hello = Hello((), FPS, Encoding[encoding.upper()], credits=64)
    sessions = [Session(bundled(), hello, StreamLimits()) for _ in range(streams)]
    members = [Member(session, lambda body: None, lambda: True, _raise) for session in sessions]
    spent = []
    for turn in range(turns):
        at = slice(turn % len(motion), turn % len(motion) + 1)
        body = encode_client(Poses(turn + 1, 0.0, motion.poses[at], motion.transl[at]))
        started = time.process_time()
        for session in sessions:
            session.take(decode_client(body))
            session.take(Credit(1))
        for first in range(0, streams, STREAMS):
            advance(members[first : first + STREAMS], stages)
        spent.append(time.process_time() - started)
    return 1e3 * float(np.median(spent[3:])) / streams


@cache
def bundled() -> Avatar:
    """The bundled avatar, loaded once."""
    return load_avatar(BUNDLED_AVATARS / "default", Settings().chunk_frames)


def _raise(error: Exception) -> None:
    raise error


@contextmanager
def servers(count: int) -> Iterator[tuple[list[int], list[int]]]:
    """Ports and process ids of so many services of the bundled avatar."""
    command = [sys.executable, "-m", "caphy.cli", "serve", "--port", "0"]
    environment = {**os.environ, "CAPHY_STREAM_MAX_CLIENT_STREAMS": "512", "CAPHY_LOG_LEVEL": "error"}
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) for _ in range(count)]
    try:
        yield [_port(process) for process in running], [process.pid for process in running]
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait(timeout=20)


def _port(process: subprocess.Popen[str]) -> int:
    assert process.stdout is not None
    line = process.stdout.readline()
    if "http://" not in line:
        raise RuntimeError(f"the service did not start: {line}")
    return int(line.split("http://")[1].split()[0].rsplit(":", 1)[1])


def processor_seconds(pid: int) -> float:
    """Of a process so far."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rsplit(") ", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def bisect(arguments: Arguments, ports: list[int], pids: list[int]) -> int:
    """The most streams held, printing every trial."""
    held, failed, streams = 0, arguments.most + 1, min(16, arguments.most)
    with get_context("spawn").Pool(1) as pool:
        while failed - held > max(2, held // 16):
            before = sum(map(processor_seconds, pids))
            found = pool.apply(trial, (ports, streams, arguments.encoding, arguments.seconds))
            server_cpu = (sum(map(processor_seconds, pids)) - before) / (arguments.seconds + WARM_UP)
            good = found["p99"] < DEADLINE_MS and found["answered"] >= HELD
            print(
                f"  {streams:7}{found['p50']:10.1f}{found['p99']:10.1f}{found['answered']:11.2%}"
                f"{server_cpu:12.2f}{found['client_cpu']:12.2f}   {'held' if good else 'not held'}",
                flush=True,
            )
            time.sleep(1)
            held, failed = (max(held, streams), failed) if good else (held, min(failed, streams))
            streams = min(2 * held, arguments.most) if failed > arguments.most else (held + failed) // 2
            if held >= arguments.most:
                break
    return held


def main(arguments: Arguments) -> None:
    """Bisect, and say on what."""
    cores = len(os.sched_getaffinity(0))
    print(
        f"streams of 30 poses a second, two garments of the bundled avatar, {arguments.encoding}; "
        f"{arguments.processes} server processes and one of clients on {cores} cores, "
        f"load before {os.getloadavg()[0]:.1f}"
    )
    alone = cost(1, arguments.encoding, 200)
    print(f"cost of a stream's frame, of one stream at a time: {alone:.2f} ms of processor time")
    for count in (4, STREAMS):
        found = cost(count, arguments.encoding, 60)
        print(f"  of {count:2} streams together: {found:.2f} ms, {found / alone:.2f} of it")
    print(f"  {'streams':>7}{'p50 ms':>10}{'p99 ms':>10}{'answered':>11}{'server cpu':>12}{'client cpu':>12}")
    with servers(arguments.processes) as (ports, pids):
        held = bisect(arguments, ports, pids)
    print(f"held with p99 below {DEADLINE_MS:.0f} ms: {held} streams, {2 * held * FPS:.0f} garment frames a second")
    print(json.dumps({"held": held, "processes": arguments.processes, "cores": cores, "encoding": arguments.encoding}))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
