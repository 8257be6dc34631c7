"""Processes that share work end when their parent is killed, even where nobody tells them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PARENT = """
import os, sys, time
from caphy.processes import executor

if __name__ == "__main__":
    with executor(2) as pool:
        print(*{pool.submit(os.getpid).result() for _ in range(20)}, flush=True)
        time.sleep(600)
"""


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


def test_a_parent_that_is_killed_leaves_nobody_behind(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    workers = [int(pid) for pid in parent.stdout.readline().split()]
    try:
        assert workers and all(_alive(pid) for pid in workers)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        until = time.monotonic() + 30
        while any(_alive(pid) for pid in workers) and time.monotonic() < until:
            time.sleep(0.1)
        assert not [pid for pid in workers if _alive(pid)]
    finally:
        for pid in filter(_alive, workers):
            os.kill(pid, signal.SIGKILL)


_DEFAULT = "signal.signal(signal.SIGINT, signal.SIG_DFL); os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
HEEDS = (sys.executable, "-c", f"import os, signal, sys; {_DEFAULT}")
"""Python that heeds Ctrl-C, also where the tests run in the background of a shell, whose jobs ignore it."""

STOPPED = """
import os, signal, sys, threading, time
from caphy.refit.crew import Crew

if __name__ == "__main__":
    threading.Timer(float(sys.argv[1]), os.killpg, (os.getpgrp(), signal.SIGINT)).start()
    try:
        with Crew(size=2) as crew:
            time.sleep(60)
    except KeyboardInterrupt:
        print("stopped")
"""


@pytest.mark.parametrize("after", [0.05, 0.5, 1.5])
def test_ctrl_c_amid_their_beginning_leaves_no_traceback(tmp_path: Path, after: float) -> None:
    script = tmp_path / "parent.py"
    script.write_text(STOPPED)
    ended = subprocess.run(
        [*HEEDS, str(script), str(after)], capture_output=True, text=True, start_new_session=True, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "stopped\n", "")


WRITING = """
import os, signal, sys, threading, time, types
from caphy.cli import command
from caphy.refit.crew import Crew

def main(arguments):
    for after in map(float, sys.argv[2:]):
        threading.Timer(after, os.killpg, (os.getpgrp(), signal.SIGINT)).start()
    with Crew(size=2) as crew:
        for each in crew._each:
            each.submit(len, bytes(20_000_000))  # more than a pipe holds
        time.sleep(60)

if __name__ == "__main__":
    sys.modules["caphy.commands.compare"] = types.SimpleNamespace(main=main)
    sys.argv[:1] = ["caphy", "compare"]
    command()
"""


@pytest.mark.parametrize("after", [("0.3",), ("0.3", "0.301", "0.32", "0.35")])
def test_ctrl_c_does_not_wait_for_what_is_written_to_processes_that_are_gone(
    tmp_path: Path, after: tuple[str, ...]
) -> None:
    """Nor does another one, of somebody who is impatient, break off the ending."""
    script = tmp_path / "parent.py"
    script.write_text(WRITING)
    ended = subprocess.run(
        [*HEEDS, str(script), *after], capture_output=True, text=True, start_new_session=True, check=False, timeout=60
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")


def test_what_timeout_sends_ends_it_as_ctrl_c_does(tmp_path: Path) -> None:
    """To the command alone, whose processes and semaphores nobody else would clear away."""
    script = tmp_path / "parent.py"
    script.write_text(
        WRITING.replace("os.killpg, (os.getpgrp(), signal.SIGINT)", "os.kill, (os.getpid(), signal.SIGTERM)")
    )
    ended = subprocess.run([*HEEDS, str(script), "0.3"], capture_output=True, text=True, check=False, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (143, "", "")


SLOWLY = """
import multiprocessing.synchronize, threading, time
unlink = multiprocessing.synchronize.sem_unlink

def slowly(name):
    unlink(name)
    if threading.current_thread() is not threading.main_thread():
        time.sleep(0.5)

multiprocessing.synchronize.sem_unlink = slowly
"""


LAUNCHED_SLOWLY = """
import time
from multiprocessing import util
launch = util.spawnv_passfds

def slowly(*given):
    pid = launch(*given)
    until = time.monotonic() + 1
    while time.monotonic() < until:
        time.sleep(0.01)
    return pid

util.spawnv_passfds = slowly
"""


@pytest.mark.parametrize(("kill", "status"), [(None, 130), ("os.kill, (os.getpid(), signal.SIGTERM)", 143)])
def test_no_process_is_left_amid_its_beginning(tmp_path: Path, kill: str | None, status: int) -> None:
    """What a thread was told by a signal the main thread acts on, also where it has blocked it."""
    script = tmp_path / "parent.py"
    stopped = WRITING if kill is None else WRITING.replace("os.killpg, (os.getpgrp(), signal.SIGINT)", kill)
    script.write_text(LAUNCHED_SLOWLY + stopped)
    ended = subprocess.run(
        [*HEEDS, str(script), "1.2"], capture_output=True, text=True, start_new_session=True, check=False, timeout=60
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (status, "", "")


def test_no_thread_is_stopped_amid_clearing_away_its_semaphore(tmp_path: Path) -> None:
    """As on a machine with more to do: threads that write end when the processes do that they write to."""
    script = tmp_path / "parent.py"
    script.write_text(SLOWLY + WRITING)
    ended = subprocess.run(
        [*HEEDS, str(script), "0.5"], capture_output=True, text=True, start_new_session=True, check=False, timeout=60
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")
