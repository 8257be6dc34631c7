"""``python -m caphy``."""

from __future__ import annotations

import subprocess
import sys


def test_the_package_runs_as_the_command_does() -> None:
    ran = [
        subprocess.run([sys.executable, "-m", "caphy", *words], capture_output=True, text=True, check=False)
        for words in (["--help"], ["fly"])
    ]
    assert ran[0].returncode == 0 and "usage: caphy COMMAND" in ran[0].stdout
    assert ran[1].returncode == 2 and "there is no command 'fly'" in ran[1].stderr
