"""Output that nobody reads to its end is no error."""

from __future__ import annotations

import subprocess
import sys


def test_a_reader_that_has_seen_enough_gets_no_traceback():
    command = [sys.executable, "-m", "caphy.cli", "effects", "list"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        complaints = process.stderr.read()
        assert process.wait(timeout=120) == 141
    assert complaints == ""
