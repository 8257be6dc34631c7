"""Who is computed next: every stream that has something to do, one job after another, in the event loop itself.

A job is a frame or a few, a fraction of a millisecond each. Handing it to a thread and back takes two more wake-ups by
the system, which on a busy machine are the longest part of an answer's time (measured: 40 ms instead of 8), and
onnxruntime is fastest on one thread for each process anyway. Between two jobs the event loop serves its sockets.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from service.stream.computing import compute
from service.stream.session import Session


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

    def __init__(self) -> None:
        self._ready: dict[Member, None] = {}
        self._waiting = False

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
        if self._ready:
            member = next(iter(self._ready))
            del self._ready[member]
            try:
                if advance(member):
                    self._ready[member] = None
            except Exception as error:  # one stream's end, not the others'
                member.fail(error)
        self._plan_turn()


def advance(member: Member) -> bool:
    """Do the next thing that a stream has to do; whether there was one."""
    job = member.session.next_job(member.free())
    message = job if job is None or isinstance(job, bytes) else compute(member.session, job)
    if message is not None:
        member.send(message)
    return job is not None
