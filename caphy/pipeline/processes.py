"""A command of caphy shared by several processes, as torchrun does it."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Sequence

from caphy.errors import CaphyError

_TELL_OF_PARENTS_DEATH = 1  # PR_SET_PDEATHSIG


def run_shared(words: Sequence[str], processes: int) -> int:
    """Run ``caphy`` with arguments ``words`` in processes that find each other, and pass on what they print.

    Returns:
        The exit status; 130 if it was interrupted, once all processes have ended.
    """
    torchrun = [sys.executable, "-m", __name__, "--standalone", "--nproc-per-node", str(processes)]
    command = [*torchrun, "-m", "caphy.cli", *words]
    environment = {"OMP_NUM_THREADS": "1"} | os.environ  # what torchrun sets, without its telling so
    try:
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        ) as running:
            assert running.stdout is not None
            try:
                for line in running.stdout:
                    print(line, end="", flush=True)
            except KeyboardInterrupt:
                running.send_signal(signal.SIGINT)
                running.wait()
                return 130
            return running.wait()
    except OSError as error:
        raise CaphyError(f"cannot start {processes} processes with {sys.executable}: {error}") from error


def _torchrun() -> None:
    """torchrun that is told to end when its parent is killed, however: nobody else would end its processes."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_TELL_OF_PARENTS_DEATH, signal.SIGTERM)
    from torch.distributed.run import main

    main()


if __name__ == "__main__":
    _torchrun()
