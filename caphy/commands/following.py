"""The next command to run, as a shell takes it."""

from __future__ import annotations

import shlex


def following(*words: object) -> str:
    """``caphy`` with arguments; those with spaces in quotes."""
    return shlex.join(["caphy", *map(str, words)])
