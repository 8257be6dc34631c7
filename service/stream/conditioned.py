"""A stream's clock where its poses are conditioned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from caphy.conditioning import Body, Conditioner, Conditioning, Frame
from caphy.conditioning.seen import checked
from caphy.errors import CaphyError
from service.conditioned import arrays, require_seconds, settled_at

NEVER: Final = -1
CLOSE: Final = 1.0
"""Frames by which a message may span more: full messages of poses at rates a little below the avatar's (29.97) do."""


@dataclass(frozen=True, eq=False)
class Conditions:
    """What was done to N frames: ``did`` (N,) uint8 of :class:`caphy.conditioning.Did`, where garments begin anew, and
    the moment of the first on the poses' clock [s], 0 where there are none."""

    did: np.ndarray
    settle: tuple[int, ...]
    time: float


NOTHING: Final = Conditions(np.zeros(0, np.uint8), (), 0.0)


class ConditionedClock:
    """Turns poses into frames at the avatar's rate by a :class:`Conditioner`.

    ``pose_fps`` [Hz] gives times to poses that come without them. ``longest``: frames that are answered at once at
    most; a longer silence is left out. ``continued``: the first frame goes on from a state that the client gave.
    """

    def __init__(
        self, settings: Conditioning, body: Body, pose_fps: float, longest: int, continued: bool = False
    ) -> None:
        self.pose_fps = pose_fps
        self._longest = longest
        self._silence = (longest - 1) / settings.fps - settings.latency
        self._conditioner = Conditioner(settings, body, longest=self._silence)
        self._continued = continued
        self._number = NEVER
        self._time = -np.inf

    @property
    def latency(self) -> float:
        """What is stated [s]."""
        return self._conditioner.settings.latency

    @property
    def number(self) -> int:
        """Of the newest pose, 0 before the first."""
        return max(0, self._number)

    def restart(self) -> None:
        """The next pose is tick 0 of a new motion."""
        self._conditioner.restart()
        self._number, self._time = NEVER, -np.inf
        self._continued = False

    def take(
        self,
        number: int,
        poses: np.ndarray,
        transl: np.ndarray,
        times: np.ndarray | None,
        confidence: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray, Conditions]:
        """Poses (N, 55, 3) and transl (N, 3), float32, of the frames that are complete after poses (T, 55, 3) from
        ``number`` on, and what was done to them.

        Raises CaphyError where numbers do not rise, times are no seconds or span more than ``longest`` frames, or
        confidences are no shares; then nothing has happened.
        """
        if number <= self._number:
            raise CaphyError(f"numbers must rise: after {self._number} came {number}; reset starts a new motion")
        if times is None:
            first = 0.0 if self._time == -np.inf else self._time + (number - self._number) / self.pose_fps
            times = first + np.arange(len(poses)) / self.pose_fps
        require_seconds(times)
        rising = np.maximum.accumulate(np.append(self._time, times[np.isfinite(times)]))
        self._require_short(np.diff(rising))
        trust = [None] * len(poses) if confidence is None else confidence
        seen = list(zip(poses, transl, trust, strict=True))
        for i, pose in enumerate(seen):  # of all before any is taken: what is refused must leave the stream as it was
            try:
                checked(*pose)
            except CaphyError as error:
                raise CaphyError(f"pose {number + i}: {error}") from error
        frames: list[Frame] = []
        for time, pose in zip(times, seen, strict=True):
            frames += self._conditioner.push(float(time), *pose)
        self._number, self._time = number + len(poses) - 1, float(rising[-1])
        return *arrays(frames), self._conditions(frames)

    def _require_short(self, steps: np.ndarray) -> None:
        """Refuse the steps (T,) [s] that time goes on by in a message where that makes too many frames.

        Time stamps that do not rise and silences that are left out make none, as the conditioner has it; before a
        silence come those that had waited.
        """
        waits = latency = self._conditioner.settings.latency
        span = 0.0
        for step in steps.tolist():
            if step > self._silence:
                span, waits = span + waits, 0.0
            else:
                span, waits = span + max(0.0, waits + step - latency), min(latency, waits + step)
        if span * self._conditioner.settings.fps > self._longest + CLOSE:
            raise CaphyError(
                f"times of one message, from the pose before it on, may span {self._longest} frames of the avatar's, "
                f"got {span:.3f} s; send fewer poses at a time"
            )

    def _conditions(self, frames: list[Frame]) -> Conditions:
        if not frames:
            return NOTHING
        settle = settled_at(frames)
        if self._continued:
            settle, self._continued = tuple(i for i in settle if i), False
        return Conditions(np.array([int(frame.did) for frame in frames], np.uint8), settle, frames[0].time)
