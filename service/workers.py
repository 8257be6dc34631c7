"""Several processes on one port: starts them, replaces those that die, stops them together.

Each worker is this module run as a program. It inherits the listening socket and two pipes: on one it reports once that
it is ready, on the other it notices that its parent is gone.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import Final

from caphy.errors import CaphyError
from service.metrics import SHARED_FOLDER
from service.report import Report, make_report
from service.settings import Settings

log = logging.getLogger("caphy.service")
STEADY_SECONDS: Final = 10.0
"""A worker that lived for so long was well; one that did not is replaced more and more slowly."""
MOST_DELAY: Final = 30.0
LOOK_SECONDS: Final = 0.1
_METRICS: Final = "caphy-metrics-"


class Worker:
    """One process."""

    def __init__(self, listener: socket.socket, settings: Settings, alive: int) -> None:
        ours, theirs = os.pipe()
        command = [sys.executable, "-m", "service.workers", str(listener.fileno()), str(theirs), str(alive)]
        self.process = subprocess.Popen(
            command, pass_fds=(listener.fileno(), theirs, alive), env=_environment(settings), stdin=subprocess.DEVNULL
        )
        os.close(theirs)
        os.set_blocking(ours, False)
        self._pipe = ours
        self._said = b""
        self.started = time.monotonic()

    def report(self) -> Report | None:
        """Its report once it is ready."""
        with suppress(BlockingIOError):  # nothing said yet
            self._said += os.read(self._pipe, 1 << 16)
        return Report(**json.loads(self._said)) if self._said.endswith(b"\n") else None

    def close(self) -> None:
        """Forget it; it has ended."""
        os.close(self._pipe)


class Workers:
    """``settings.workers`` processes that answer on ``listener``."""

    def __init__(self, listener: socket.socket, settings: Settings) -> None:
        self._listener = listener
        self._settings = settings
        self._workers: list[Worker] = []
        self._delay = 0.0
        self._start_at = 0.0
        self._stopping = False
        self._alive, self._our_end = os.pipe()  # our end closes with us, however we end; workers read that

    def run(self, on_ready: Callable[[Report], None]) -> None:
        """Start them, call ``on_ready`` with the first report, and keep their number until told to stop.

        Raises CaphyError where the first worker ends before it is ready.
        """
        handlers = {number: signal.signal(number, self._stop) for number in (signal.SIGINT, signal.SIGTERM)}
        folder, held = _metrics_folder()
        os.environ[SHARED_FOLDER] = str(folder)
        try:
            if report := self._first_report():
                on_ready(report)
            while not self._stopping:
                self._replace_the_dead()
                time.sleep(LOOK_SECONDS)
        finally:
            self._end_all()
            shutil.rmtree(folder, ignore_errors=True)
            os.close(held)
            del os.environ[SHARED_FOLDER]  # what is started later must not look for it
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._stopping = True

    def _start(self) -> Worker:
        worker = Worker(self._listener, self._settings, self._alive)
        self._workers.append(worker)
        return worker

    def _first_report(self) -> Report | None:
        """None where we are told to stop before it comes: as orderly an end as any later one."""
        first = self._start()
        while not self._stopping:
            if report := first.report():
                return report
            if first.process.poll() is not None:
                raise CaphyError("the first worker ended before it was ready; its words above say why")
            time.sleep(LOOK_SECONDS)
        return None

    def _replace_the_dead(self) -> None:
        for worker in [w for w in self._workers if w.process.poll() is not None]:
            self._workers.remove(worker)
            worker.close()
            _forget_metrics(worker.process.pid)
            lived = time.monotonic() - worker.started
            self._delay = 0.0 if lived > STEADY_SECONDS else min(MOST_DELAY, 2 * self._delay + 0.5)
            self._start_at = time.monotonic() + self._delay
            facts = {"pid": worker.process.pid, "status": worker.process.returncode, "seconds": round(lived, 1)}
            log.error("a worker has died and is replaced", extra=facts)
        if len(self._workers) < self._settings.workers and time.monotonic() >= self._start_at:
            self._start()

    def _end_all(self) -> None:
        """Ask every worker to finish what is in flight; end those that take too long."""
        self._listener.close()
        for worker in self._workers:
            worker.process.terminate()
        deadline = time.monotonic() + self._settings.drain_seconds + 5
        for worker in self._workers:
            try:
                worker.process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                worker.process.kill()
                worker.process.wait()
            worker.close()


def _environment(settings: Settings) -> dict[str, str]:
    """Ours, with the settings as this process has them: the command line may have changed some."""
    environment = dict(os.environ)
    for name, value in settings.model_dump(exclude_none=True).items():
        secret = getattr(value, "get_secret_value", None)
        environment[f"CAPHY_{name.upper()}"] = str(secret() if secret else value)
    return environment


def _metrics_folder() -> tuple[Path, int]:
    """Of the numbers that workers share, and a descriptor that holds it; in memory where the system has a place for
    that, writable or not else. What services that were killed left there, which nobody holds any more, goes."""
    memory = Path("/dev/shm")
    place = memory if os.access(memory, os.W_OK) else Path(tempfile.gettempdir())
    for left in place.glob(f"{_METRICS}*"):
        with suppress(OSError):  # it is held, or another user's
            os.close(_hold(left))
            shutil.rmtree(left, ignore_errors=True)
    try:
        new = Path(tempfile.mkdtemp(prefix="caphy-new-", dir=place))
        held = _hold(new)
        return new.rename(place / new.name.replace("caphy-new-", _METRICS)), held  # held before anybody looks for it
    except OSError as error:
        raise CaphyError(f"several workers need a writable folder for their metrics ({error}); set TMPDIR") from error


def _hold(folder: Path) -> int:
    """A descriptor of a folder, held until it is closed or its process ends; raises OSError where another holds it."""
    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(held)
        raise
    return held


def _forget_metrics(pid: int) -> None:
    from prometheus_client.multiprocess import mark_process_dead

    mark_process_dead(pid)


def _end_with_parent(alive: int) -> None:
    """Stop this process when the other end of a pipe closes."""
    os.read(alive, 1)
    os.kill(os.getpid(), signal.SIGTERM)


def main(listener: int, report: int, alive: int) -> None:
    """Be a worker: answer on an inherited socket until told to stop."""
    from service.app import create_app
    from service.server import make_server
    from service.settings import read_settings

    settings = read_settings()
    app = create_app(settings)
    server = make_server(app, settings)
    app.state.library.load()
    threading.Thread(target=_end_with_parent, args=(alive,), daemon=True).start()
    os.write(report, json.dumps(asdict(make_report(app.state.library.avatars))).encode() + b"\n")
    os.close(report)
    server.run(sockets=[socket.socket(fileno=listener)])


if __name__ == "__main__":
    try:
        main(*map(int, sys.argv[1:]))
    except CaphyError as refused:
        print(f"caphy serve: {refused}", file=sys.stderr)
        sys.exit(2)
