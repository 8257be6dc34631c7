"""``caphy serve`` as a process of its own, for tests that hurt it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any
from urllib.request import urlopen


@dataclass
class LiveService:
    """A running service: its process, address and log."""

    process: subprocess.Popen[str]
    url: str
    said: list[str]
    log: IO[bytes]

    @property
    def port(self) -> int:
        return int(self.url.rpartition(":")[2])

    def workers(self) -> list[int]:
        """Process ids of its workers."""
        pid = self.process.pid
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]

    def logged(self) -> list[dict[str, Any]]:
        """Lines of its log so far; any that is not JSON fails."""
        lines = written(self.log).splitlines()
        strange = [line for line in lines if not line.startswith("{")]
        assert strange == [], strange
        return [json.loads(line) for line in lines]

    def count(self, message: str) -> int:
        """How often its log says ``message``."""
        return sum(line["message"] == message for line in self.logged())

    def number(self, name: str) -> float:
        """The sum of a metric's samples."""
        with urlopen(self.url + "/metrics", timeout=10) as response:
            lines = response.read().decode().splitlines()
        return sum(float(line.rpartition(" ")[2]) for line in lines if re.match(rf"{name}[ {{]", line))

    def stop(self) -> int:
        """Tell it to stop; its exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=20)


def written(log: IO[bytes]) -> str:
    """What ``log`` holds.

    Read without moving its place: the service writes through the same open file, so a reader
    that goes back to its start would let the next line be written over the first ones.
    """
    return os.pread(log.fileno(), os.fstat(log.fileno()).st_size, 0).decode()


@contextmanager
def live_service(avatars: Path, *arguments: str, **environment: str) -> Iterator[LiveService]:
    """A service on a free port; killed at the end if it still runs."""
    command = [sys.executable, "-m", "caphy.cli", "serve", "--avatars", str(avatars), "--port", "0", *arguments]
    with TemporaryFile() as log:
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, text=True, env={**os.environ, **environment}
        )
        assert process.stdout is not None
        try:
            said = [process.stdout.readline() for _ in range(3)]
            found = re.search(r"http://\S+", said[0])
            if not found:
                raise AssertionError(said[0] + written(log))
            yield LiveService(process, found[0], said, log)
        finally:
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(timeout=10)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
            process.stdout.close()


def wait_until(condition, seconds: float = 60.0) -> None:
    """Fail unless ``condition`` holds in so many seconds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)
