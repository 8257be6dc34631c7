"""Poses at the client's rate become poses at the avatar's, without ever looking ahead."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io.poses.sequence import interpolate

NEVER: Final = -1
CLOSE: Final = 1e-6
"""Ticks; as in :meth:`caphy.io.poses.PoseSequence.resample`, whose answer a stream's parts make together."""


class CausalClock:
    """Turns numbered poses into ticks of the avatar's clock.

    A pose's number is its time: number n lies (n - m) / fps after number m. The first pose is tick 0. A tick is
    answered as soon as a pose at its time or later is there, by slerp between the poses on both sides; so nothing is
    guessed, and a tick waits at most for one pose. Numbers left out are thereby filled in; but a gap of more than
    ``longest`` ticks counts as a single step, because nobody knows what happened meanwhile.
    """

    def __init__(self, fps: float, pose_fps: float, longest: int) -> None:
        self._fps, self._longest = fps, longest
        self.pose_fps = pose_fps
        self.restart()

    def restart(self) -> None:
        """The next pose is tick 0 of a new motion."""
        self._number = NEVER
        self._time = 0.0
        self._next = 0
        self._pose = self._transl = np.zeros(0, np.float32)

    @property
    def number(self) -> int:
        """Of the newest pose, 0 before the first."""
        return max(0, self._number)

    def take(self, number: int, poses: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses (N, 55, 3) and transl (N, 3), float32, of the ticks that poses (T, 55, 3) from ``number`` on complete.

        Raises CaphyError where numbers do not rise, or more than ``longest`` ticks would be answered at once; then
        nothing has happened.
        """
        if number <= self._number:
            raise CaphyError(f"numbers must rise: after {self._number} came {number}; reset starts a new motion")
        step = self._fps / self.pose_fps
        gap = (number - self._number) * step
        started = self._number != NEVER
        if not started:
            gap = 0.0
        elif gap > max(self._longest, step):
            gap = step
        times = self._time + gap + step * np.arange(len(poses))
        wanted = np.arange(self._next, int(np.floor(times[-1] + CLOSE)) + 1)
        if len(wanted) > self._longest:
            raise CaphyError(
                f"at most {self._longest} frames are answered at once, {len(poses)} poses at {self.pose_fps:g} fps "
                f"make {len(wanted)} at {self._fps:g}; send fewer at a time"
            )
        ticks = self._ticks(started, times, wanted, poses, transl)
        self._number, self._time, self._next = number + len(poses) - 1, float(times[-1]), self._next + len(wanted)
        self._pose, self._transl = poses[-1], transl[-1]
        return ticks

    def _ticks(
        self, started: bool, times: np.ndarray, wanted: np.ndarray, poses: np.ndarray, transl: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        if len(wanted) == len(times) and np.abs(times - wanted).max() < CLOSE:
            return np.ascontiguousarray(poses, np.float32), np.ascontiguousarray(transl, np.float32)
        if len(wanted) == 0:
            return np.zeros((0, *poses.shape[1:]), np.float32), np.zeros((0, 3), np.float32)
        if started:
            times = np.concatenate([[self._time], times])
            poses = np.concatenate([self._pose[None], poses])
            transl = np.concatenate([self._transl[None], transl])
        if len(times) == 1:
            return np.ascontiguousarray(poses, np.float32), np.ascontiguousarray(transl, np.float32)
        within = np.clip(wanted, times[0], times[-1])
        found = interpolate(poses.astype(np.float64), transl.astype(np.float64), times, within)
        return found[0].astype(np.float32), found[1].astype(np.float32)
