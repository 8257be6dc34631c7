"""What a process says of itself when it is ready: how long it took to start, and what it holds in memory."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from service.avatars import Avatar
from service.metrics import resident_bytes

IMPORTED_AT: Final = time.monotonic()


@dataclass(frozen=True)
class Report:
    """Seconds since the process started, its memory in all, and seconds and memory by avatar."""

    seconds: float
    resident_bytes: int
    avatars: dict[str, tuple[float, int]]

    def lines(self) -> list[str]:
        """For people."""
        said = [f"cold start {self.seconds:.1f} s; memory of the process {self.resident_bytes / 1e6:.0f} MB"]
        for name, (seconds, count) in self.avatars.items():
            said.append(f"  avatar {name}: loaded and warm in {seconds:.1f} s, {count / 1e6:.0f} MB")
        return said


def make_report(avatars: dict[str, Avatar]) -> Report:
    """The report of this process."""
    facts = {avatar.id: (avatar.loaded_seconds, avatar.loaded_bytes) for avatar in avatars.values()}
    return Report(_seconds_running(), resident_bytes(), facts)


def _seconds_running() -> float:
    """Since the process started; since this module was imported where the system does not say."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):
        return time.monotonic() - IMPORTED_AT
