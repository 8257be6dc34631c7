"""Round trips over loopback HTTP: JSON against binary.

python -m benchmarks.wire
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from http.client import HTTPConnection
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tyro
import uvicorn

from benchmarks.latency import shirt, shirt_avatar
from caphy.io.bundle import write_bundle
from caphy.io.procedural import procedural_motion
from service.app import create_app
from service.protocol import MEDIA_TYPE, FramesRequest, decode_response, encode_request
from service.settings import Settings

VERTICES = 4424


def milliseconds(work: Callable[[], object], seconds: float = 2.0) -> float:
    """Median over runs in ``seconds``."""
    times, end = [], time.perf_counter() + seconds
    work()
    while len(times) < 10 or time.perf_counter() < end:
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times))


def post(connection: HTTPConnection, body: bytes, media_type: str) -> tuple[bytes, float]:
    """The answer's bytes, and the service's own share [ms] of the time."""
    headers = {"content-type": media_type, "accept": media_type}
    connection.request("POST", "/avatars/bench/frames", body, headers)
    response = connection.getresponse()
    content = response.read()
    if response.status != 200:
        raise RuntimeError(content.decode(errors="replace"))
    return content, sum(float(part.split("=")[1]) for part in (response.getheader("server-timing") or "").split(","))


def compare(connection: HTTPConnection, frames: int) -> None:
    """Print both encodings' round trips, client's encoding and decoding included."""
    motion = procedural_motion(seconds=4)[:frames]
    request = FramesRequest(motion.poses, motion.transl, 30.0, np.zeros(0))

    def binary() -> tuple[int, float]:
        content, share = post(connection, encode_request(request), MEDIA_TYPE)
        decode_response(content)
        return len(content), share

    def text() -> tuple[int, float]:
        asked = {"fps": 30, "poses": motion.poses.tolist(), "transl": motion.transl.tolist()}
        content, share = post(connection, json.dumps(asked).encode(), "application/json")
        np.array(json.loads(content)["garments"]["shirt"]["vertices"], np.float32)
        return len(content), share

    base = milliseconds(binary)
    for name, work in (("binary", binary), ("JSON", text)):
        size, share = work()
        taken = base if work is binary else milliseconds(work)
        print(f"  {frames:3} frames  {name:7}{taken:10.2f} ms{taken / base:7.1f}x{size / 1e3:12.1f} kB{share:10.2f} ms")


def main() -> None:
    """One service in this process, one client."""
    with TemporaryDirectory() as folder:
        write_bundle(shirt_avatar(shirt(VERTICES), 64), Path(folder) / "bench")
        server = uvicorn.Server(uvicorn.Config(create_app(Settings(avatars=Path(folder))), port=0, log_level="warning"))
        thread = threading.Thread(target=server.run, daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.05)
        connection = HTTPConnection("127.0.0.1", server.servers[0].sockets[0].getsockname()[1])
        print(f"one garment, {VERTICES:,} vertices; round trip with the client's own encoding and decoding, median")
        print(f"  {'':19}{'round trip':>12}{'ratio':>8}{'answer':>15}{'in service':>13}")
        for frames in (1, 60):
            compare(connection, frames)
        server.should_exit = True
        thread.join(timeout=10)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
