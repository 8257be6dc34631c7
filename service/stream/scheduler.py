"""Who is computed next: all streams that have something to do, together, in one thread."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from service import frames
from service.encodings import Meshes
from service.stream.batches import run_batch
from service.stream.session import Job, Session


@dataclass(eq=False)
class Member:
    """A stream as the scheduler sees it.

    send: takes a message for the client. free: whether the last one is on its way. fail: ends the stream. gone: it has
    ended.
    """

    session: Session
    send: Callable[[bytes], None]
    free: Callable[[], bool]
    fail: Callable[[Exception], None]
    gone: bool = False


class Scheduler:
    """Computes for all streams of a process. Call its methods from the event loop.

    One thread is enough, because onnxruntime is fastest on one thread per process; while it works on one batch of
    streams, the next one gathers.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "streams")
        self._ready: dict[Member, None] = {}
        self._running: asyncio.Task[None] | None = None

    def wake(self, member: Member) -> None:
        """Something may be to do for a stream."""
        self._ready[member] = None
        if self._running is None:
            self._running = asyncio.get_running_loop().create_task(self._run())

    def forget(self, member: Member) -> None:
        """The stream has ended."""
        member.gone = True
        self._ready.pop(member, None)

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            while self._ready:
                batch = self._gather()
                if batch:
                    self._deliver(batch, await loop.run_in_executor(self._thread, compute, batch))
        finally:
            self._running = None

    def _gather(self) -> list[tuple[Member, Job]]:
        """The next job of every stream that has one; messages that need no computing are sent."""
        ready, self._ready = self._ready, {}
        batch = []
        for member in ready:
            try:
                job = next_job(member)
            except Exception as error:  # one stream's end, not the others'
                member.fail(error)
                continue
            if job is not None:
                batch.append((member, job))
        return batch

    def _deliver(self, batch: list[tuple[Member, Job]], messages: list[bytes | Exception | None]) -> None:
        for (member, _), message in zip(batch, messages, strict=True):
            if isinstance(message, Exception):
                member.fail(message)
            elif not member.gone:
                self._ready[member] = None
                if message is not None:
                    member.send(message)


def next_job(member: Member) -> Job | None:
    """What is to be computed for a stream; messages that need no computing are sent at once."""
    while True:
        job = member.session.next_job(member.free())
        if not isinstance(job, bytes):
            return job
        member.send(job)


def compute(batch: list[tuple[Member, Job]]) -> list[bytes | Exception | None]:
    """The message to send for every job, or none, or what went wrong; in the scheduler's thread."""
    try:
        found = run_batch([(member.session, job) for member, job in batch])
    except Exception as error:
        return [error] * len(batch)
    return [_finished(member.session, job, *result) for (member, job), result in zip(batch, found, strict=True)]


def _finished(
    session: Session, job: Job, shown: dict[str, np.ndarray], states: dict[str, np.ndarray]
) -> bytes | Exception | None:
    try:
        for engine in session.engines:
            frames.require_finite(engine.name, shown[engine.name], states[engine.name])
        meshes = Meshes(0)
        if job.answered is not None:
            part = slice(job.shown, None)
            kept = {name: array[part] for name, array in shown.items()}
            arrays = job.poses[part], job.transl[part], kept
            meshes = frames.packed(session.engines, *arrays, session.wanted, session.pelvis)
        return session.finish(job, meshes, states)
    except Exception as error:  # one stream's end, not the others'
        return error
