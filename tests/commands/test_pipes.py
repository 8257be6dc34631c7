"""Output that nobody reads to its end is no error."""

from __future__ import annotations

import subprocess
import sys

import pytest

import caphy.commands.simulate  # noqa: F401
from caphy.cli import main


def test_a_signal_amid_compiled_code_ends_quietly(monkeypatch):
    """Which turns the interrupt into an error of its own."""

    def stopped(arguments):
        try:
            raise KeyboardInterrupt(143)
        except KeyboardInterrupt as signal:
            raise SystemError("CPUDispatcher returned a result with an exception set") from signal

    monkeypatch.setattr("caphy.commands.simulate.main", stopped)
    assert main(["simulate"]) == 143

    def failed(arguments):
        raise SystemError("another")

    monkeypatch.setattr("caphy.commands.simulate.main", failed)
    with pytest.raises(SystemError):
        main(["simulate"])


def test_a_reader_that_has_seen_enough_gets_no_traceback():
    command = [sys.executable, "-m", "caphy.cli", "effects", "list"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        complaints = process.stderr.read()
        assert process.wait(timeout=120) == 141
    assert complaints == ""
