"""Who is computed next: every stream that has something to do, in turns, in the event loop itself.

A turn takes one job of each stream that has one, and computes them together: the more streams, the less each costs. A
job is a frame or a few, a fraction of a millisecond each. Handing it to a thread and back takes two more wake-ups by
the system, which on a busy machine are the longest part of an answer's time (measured: 40 ms instead of 8), and
onnxruntime is fastest on one thread for each process anyway. Between two turns the event loop serves its sockets.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice

from service.engine import STREAMS
from service.metrics import Stages
from service.stream.computing import compute
from service.stream.session import Job, Session


@dataclass(eq=False)
class Member:
    """A stream as the scheduler sees it.

    send: takes a message for the client. free: whether the last one is on its way. fail: ends the stream.
    """

    session: Session
    send: Callable[[bytes], None]
    free: Callable[[], bool]
    fail: Callable[[Exception], None]


class Scheduler:
    """Computes for all streams of a process, each in its turn. Call its methods from the event loop."""

    def __init__(self, stages: Stages) -> None:
        self._ready: dict[Member, None] = {}
        self._waiting = False
        self.stages = stages

    def wake(self, member: Member) -> None:
        """Something may be to do for a stream."""
        self._ready[member] = None
        self._plan_turn()

    def forget(self, member: Member) -> None:
        """The stream has ended."""
        self._ready.pop(member, None)

    def _plan_turn(self) -> None:
        if self._ready and not self._waiting:
            self._waiting = True
            asyncio.get_running_loop().call_soon(self._turn)

    def _turn(self) -> None:
        self._waiting = False
        members = list(islice(self._ready, STREAMS))
        for member in members:
            del self._ready[member]
        for member in advance(members, self.stages):
            self._ready[member] = None
        self._plan_turn()


def advance(members: Sequence[Member], stages: Stages) -> list[Member]:
    """Do the next thing that each stream has to do; returns those that had one, and live on."""
    busy, jobs = [], []
    for member in members:
        job = _next_job(member)
        if isinstance(job, bytes):
            member.send(job)
            busy.append(member)
        elif job is not None:
            jobs.append((member, job))
    answers = compute([(member.session, job) for member, job in jobs], stages) if jobs else []
    for (member, _), answer in zip(jobs, answers, strict=True):
        if isinstance(answer, Exception):
            member.fail(answer)
            continue
        busy.append(member)
        if answer is not None:
            member.send(answer)
    return busy


def _next_job(member: Member) -> Job | bytes | None:
    try:
        return member.session.next_job(member.free())
    except Exception as error:  # one stream's end, not the others'
        member.fail(error)
        return None
