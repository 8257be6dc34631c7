"""One stream's state: what has come, what may be answered, and what is computed next. It knows no sockets.

The rule of credits. A message of poses is answered if there is a credit for it. Of messages that wait, only as many as
there are credits can be answered, and the newest are; older ones are skipped. A skipped message is not sent, but it is
lived: its poses go through the networks all the same, so that every mesh is the one that a client which misses nothing
would have got. Messages wait for a credit until too many do; then the oldest are lived at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Final

import numpy as np

from caphy.errors import CaphyError
from service import frames
from service.avatars import Avatar
from service.clients.given import RATES
from service.conditioned import body_of, parse_settings
from service.encodings import Encoding, Meshes
from service.errors import Problem
from service.frames import Wanted
from service.protocol import FramesRequest
from service.states import require_states, split_states
from service.stream.clock import CausalClock
from service.stream.conditioned import ConditionedClock, Conditions
from service.stream.limits import StreamLimits
from service.stream.messages import (
    Credit,
    Dressed,
    GarmentRecord,
    GetState,
    Hello,
    Poses,
    Rate,
    Reset,
    Seen,
    State,
    Welcome,
    encode_meshes_message,
    encode_state,
)

HELD: Final = 64
"""Frames, or messages of poses, that wait for a credit before the oldest are lived; fewer than :data:`QUEUE`, or the
credit would never be read. At fast rates messages hold less than a frame each."""
LIVED_FRAMES: Final = 8
"""Skipped frames that are lived in one go, so that who is behind does not hold up the others."""
QUEUE: Final = 128
"""Messages that wait before no more are read."""


@dataclass(frozen=True, eq=False)
class Ticks:
    """A message of poses at the avatar's rate: poses (N, 55, 3) and transl (N, 3), float32; N may be 0.

    conditions: what was done to them, of a conditioned stream.
    """

    number: int
    time: float
    arrived: float
    poses: np.ndarray
    transl: np.ndarray
    conditions: Conditions | None = None

    @property
    def settle(self) -> tuple[int, ...]:
        """The frames at which garments begin anew."""
        return () if self.conditions is None else self.conditions.settle


@dataclass(frozen=True)
class Restart:
    """A reset in the queue, after the pose of ``number``."""

    number: int


@dataclass(frozen=True, eq=False)
class Job:
    """Poses to live (N, 55, 3), and which of them to show: all from ``shown`` on, as the answer to ``answered``.

    kept: the answer waits for a credit. settle: the poses at which garments begin anew.
    """

    poses: np.ndarray
    transl: np.ndarray
    shown: int
    number: int
    answered: Ticks | None
    kept: bool = False
    settle: tuple[int, ...] = ()


class Session:
    """One client's stream. Every job that :meth:`next_job` gives must be finished before it is asked again.

    Raises Problem 404 for unknown garments and 422 for a hello that cannot be answered.
    """

    def __init__(self, avatar: Avatar, hello: Hello, limits: StreamLimits) -> None:
        self.engines = avatar.select(list(hello.garments))
        self.wanted = Wanted.of(hello.encoding.label, hello.normals)
        self.pelvis = avatar.bundle.joints[0]
        self.fps = avatar.bundle.fps
        self.states = self._first_states(hello.state)
        self.limits = limits
        self.skipped = 0
        self._credits = 0
        self._tick = 0
        self._number = 0
        self._frames = 0
        self._queue: deque[Ticks | Restart | GetState] = deque()
        self._poses_waiting = 0
        self._kept: bytes | None = None
        rate, settings = (
            _checked_rate(frames.same_rate(hello.fps, self.fps)),
            parse_settings(hello.conditioning, self.fps),
        )
        self._clock: CausalClock | ConditionedClock = CausalClock(self.fps, rate, limits.max_frames)
        if settings is not None:
            body = body_of(avatar.bundle)
            continued = bool(hello.state.any())  # zeros are the state before a first frame
            self._clock = ConditionedClock(settings, body, rate, limits.max_frames, continued)
        self._add_credits(hello.credits)

    def welcome(self) -> Welcome:
        """What the server says first."""
        weights = self.wanted.encoding is Encoding.WEIGHTS
        records = [
            GarmentRecord(e.name, e.weight_count if weights else e.vertex_count, e.state_size) for e in self.engines
        ]
        latency = self._clock.latency if isinstance(self._clock, ConditionedClock) else 0.0
        return Welcome(self.fps, self.limits.max_frames, self.limits.max_credits, tuple(records), latency)

    @property
    def is_full(self) -> bool:
        """Whether messages wait for whoever computes, so that no more should be read."""
        return len(self._queue) >= QUEUE

    @property
    def is_owed(self) -> bool:
        """Whether the client waits for something that it need not ask for again."""
        return bool(self._queue) and self._credits > 0

    def take(self, message: Poses | Credit | Reset | Rate | GetState) -> None:
        """Take a message in. Raises CaphyError, and nothing has happened, where it cannot be."""
        match message:
            case Poses():
                self._take_poses(message)
            case Credit():
                self._add_credits(message.count)
            case Rate():
                self._clock.pose_fps = _checked_rate(frames.same_rate(message.fps, self.fps))
            case Reset():
                self._queue.append(Restart(self._clock.number))
                self._clock.restart()
            case GetState():
                self._queue.append(message)

    def next_job(self, free: bool) -> Job | bytes | None:
        """What to do now: poses to compute, a message to send, or nothing.

        ``free``: whether a message could be sent at once; where not, nothing is answered.
        """
        self._forget_before_reset()
        if (kept := self._kept_answer(free)) is not None:
            return kept
        while self._queue:
            first = self._queue[0]
            if isinstance(first, Restart):
                self._queue.popleft()
                self._drop_kept()
                self.states, self._tick, self._number = self._first_states(np.zeros(0)), 0, first.number
            elif isinstance(first, GetState):
                return self._state_message(first) if free else None
            else:
                return self._poses_job(free)
        return None

    def finish(self, job: Job, meshes: Meshes, states: Mapping[str, np.ndarray]) -> bytes | None:
        """The answer to a job that was computed, if it has one."""
        self.states, self._number = dict(states), job.number
        self._tick += len(job.poses)
        if job.answered is None:
            return None
        taken = 1e3 * (perf_counter() - job.answered.arrived)
        done = job.answered.conditions
        conditions = (None, 0.0) if done is None else (done.did, done.time)
        tick = self._tick - meshes.frames
        message = Dressed(job.number, self.skipped, job.answered.time, tick, taken, meshes, *conditions)
        body = b"".join(encode_meshes_message(message, self.wanted.encoding))
        if not job.kept:
            return body
        self._kept = body
        return None

    def _kept_answer(self, free: bool) -> bytes | None:
        """The answer that waited for a credit, if there is one now and nothing newer came."""
        if self._kept is not None and self._poses_waiting:
            self._drop_kept()
        if self._kept is None or not free or not self._credits:
            return None
        kept, self._kept = self._kept, None
        self._credits -= 1
        return kept

    def _drop_kept(self) -> None:
        self.skipped += self._kept is not None
        self._kept = None

    def _take_poses(self, message: Poses) -> None:
        frames.require_bounded(FramesRequest(message.poses, message.transl, self.fps, np.zeros(0)))
        if not len(message.poses):
            raise CaphyError("a message of poses must hold at least one")
        if len(message.poses) > self.limits.max_frames:
            raise CaphyError(
                f"at most {self.limits.max_frames} frames are taken at once, got {len(message.poses)}; send fewer"
            )
        last = message.number + len(message.poses) - 1
        poses, transl, conditions = self._at_the_avatars_rate(message)
        self._queue.append(Ticks(last, message.time, perf_counter(), poses, transl, conditions))
        self._poses_waiting += 1
        self._frames += len(poses)

    def _at_the_avatars_rate(self, message: Poses) -> tuple[np.ndarray, np.ndarray, Conditions | None]:
        seen = isinstance(message, Seen)
        if isinstance(self._clock, ConditionedClock):
            extra = (message.times, message.confidence) if seen else (None, None)
            return self._clock.take(message.number, message.poses, message.transl, *extra)
        if seen:
            raise CaphyError("times and confidence are for conditioned streams; ask for conditioning in hello")
        return *self._clock.take(message.number, message.poses, message.transl), None

    def _add_credits(self, count: int) -> None:
        self._credits = min(self._credits + count, self.limits.max_credits)

    def _first_states(self, given: np.ndarray) -> dict[str, np.ndarray]:
        require_states(given, self.engines)
        return split_states(self.engines, given)

    def _forget_before_reset(self) -> None:
        """Poses before a reset move nothing that anybody will see."""
        last = max((i for i, item in enumerate(self._queue) if isinstance(item, Restart)), default=0)
        if not last or any(isinstance(item, GetState) for item in self._queue):
            return
        for _ in range(last):
            item = self._queue.popleft()
            if isinstance(item, Ticks):
                self._forget(item)
                self.skipped += 1

    def _forget(self, item: Ticks) -> None:
        self._poses_waiting -= 1
        self._frames -= len(item.poses)

    def _state_message(self, request: GetState) -> bytes:
        self._queue.popleft()
        state = np.concatenate([self.states[engine.name] for engine in self.engines])
        return encode_state(State(self._number, request.time, state))

    def _poses_job(self, free: bool) -> Job | None:
        available = self._credits if free else 0
        lived: list[Ticks] = []
        count = 0
        while self._may_skip(available) and count < LIVED_FRAMES:
            lived.append(self._pop())
            count += len(lived[-1].poses)
        answered = None
        kept = not available and bool(lived) and not self._poses_waiting
        if kept:  # the state was asked for: the newest poses are lived, and still wait for their credit
            answered = lived[-1]
        self.skipped += len(lived) - kept
        if available and self._poses_waiting <= available and self._queue and isinstance(self._queue[0], Ticks):
            answered = self._pop()
            lived.append(answered)
            self._credits -= 1
        if not lived:
            return None
        poses = lived[0].poses if len(lived) == 1 else np.concatenate([item.poses for item in lived])
        transl = lived[0].transl if len(lived) == 1 else np.concatenate([item.transl for item in lived])
        shown = len(poses) - (len(answered.poses) if answered else 0)
        starts = np.cumsum([0, *(len(item.poses) for item in lived[:-1])]).tolist()
        settle = tuple(start + i for start, item in zip(starts, lived, strict=True) for i in item.settle)
        return Job(poses, transl, shown, lived[-1].number, answered, kept, settle)

    def _may_skip(self, available: int) -> bool:
        """Whether the first in the queue are poses that will not be answered and must not wait."""
        if not self._queue or not isinstance(self._queue[0], Ticks):
            return False
        if available:
            return self._poses_waiting > available
        follows = not self._credits and any(not isinstance(item, Ticks) for item in self._queue)
        return follows or (max(self._frames, self._poses_waiting) > HELD and self._poses_waiting > 1)

    def _pop(self) -> Ticks:
        item = self._queue.popleft()
        if not isinstance(item, Ticks):
            raise TypeError("the first in the queue must be poses")
        self._forget(item)
        return item


def _checked_rate(fps: float) -> float:
    if not RATES[0] <= fps <= RATES[1]:
        raise Problem(422, f"fps: must lie between {RATES[0]:g} and {RATES[1]:g}, got {fps:g}")
    return float(fps)
