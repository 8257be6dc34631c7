"""Keeps the process alive under any load: who may ask how often, how much may be held, who waits and how long.

Whoever is refused is told so at once, with ``retry-after``, before anything was computed for him.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from time import monotonic
from typing import Annotated, Final, TypeVar

import anyio
import anyio.to_thread
from fastapi import Depends, Request
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import Problem
from service.metrics import Metrics
from service.problem import problem_response
from service.settings import Settings

Answer = TypeVar("Answer")
KNOWN_CLIENTS: Final = 10_000
"""Most clients that are remembered; those that have asked for nothing for longest are forgotten first."""
ALWAYS_ANSWERED: Final = frozenset({"/health", "/ready", "/v2/health/live", "/v2/health/ready"})
"""Probes: an orchestrator must not take a busy process for a dead one."""


@dataclass
class Client:
    """One address: the requests it may still make at once, and those that are being answered."""

    tokens: float
    counted_at: float
    requests: int = 0


class Guard:
    """The limits of one process. Raises Problem 429 to a client that asks for too much, 503 to all when full."""

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self.settings = settings
        self.metrics = metrics
        self._threads = anyio.CapacityLimiter(settings.threads)
        self._unlimited = anyio.CapacityLimiter(float("inf"))
        self._inside = 0
        self._buffered = 0
        self._buffer_lock = threading.Lock()
        self._clients: OrderedDict[str, Client] = OrderedDict()
        self._burst = max(1.0, settings.max_client_rate)  # a request takes 1, so below that none would ever pass

    async def run(self, work: Callable[[], Answer]) -> Answer:
        """What ``work`` returns, computed in a thread as soon as one is free."""
        if self._inside >= self.settings.threads + self.settings.max_waiting:
            raise self.refusal(503, "overload", "the service is at its limit")
        self._inside += 1
        self.metrics.in_flight.inc()
        try:
            await self._wait_for_thread(work)
            try:
                return await anyio.to_thread.run_sync(work, limiter=self._unlimited)
            finally:
                self._threads.release_on_behalf_of(work)
        finally:
            self._inside -= 1
            self.metrics.in_flight.dec()

    async def _wait_for_thread(self, work: Callable[[], Answer]) -> None:
        try:
            self._threads.acquire_on_behalf_of_nowait(work)
        except anyio.WouldBlock:
            try:
                with anyio.fail_after(self.settings.max_wait_seconds):
                    await self._threads.acquire_on_behalf_of(work)
            except TimeoutError:
                seconds = self.settings.max_wait_seconds
                raise self.refusal(503, "deadline", f"the request waited for {seconds:g} s") from None

    def client(self, address: str) -> Client:
        """The client of that address, remembered."""
        client = self._clients.get(address)
        if client is None:
            client = self._clients[address] = Client(self._burst, monotonic())
        self._clients.move_to_end(address)
        while len(self._clients) > KNOWN_CLIENTS:
            self._clients.popitem(last=False)
        return client

    def count_request(self, client: Client) -> None:
        """Take one of the requests that the client may make per second."""
        rate, now = self.settings.max_client_rate, monotonic()
        client.tokens = min(self._burst, client.tokens + rate * (now - client.counted_at))
        client.counted_at = now
        if client.tokens < 1:
            seconds = ceil((1 - client.tokens) / rate)
            raise self.refusal(429, "rate", f"one client may send {rate:g} requests per second", seconds)
        client.tokens -= 1

    def refusal(self, status: int, reason: str, detail: str, seconds: int = 1) -> Problem:
        """The problem to raise, counted as refused; what is refused now may pass in so many seconds."""
        self.metrics.refused.labels(reason).inc()
        when = "a second" if seconds == 1 else f"{seconds} seconds"
        return Problem(status, f"{detail}; try again in {when}", {"retry-after": str(seconds)})

    def buffer(self, count: int) -> None:
        """Note ``count`` more bytes held, or fewer where it is negative; from any thread."""
        with self._buffer_lock:
            if count > 0 and self._buffered + count > self.settings.max_buffered_bytes:
                raise self.refusal(503, "memory", "the service holds as many bytes of requests and answers as it may")
            self._buffered += count
        self.metrics.buffered.inc(count)


class Hold:
    """What one request holds of the process: bytes in memory and a place among its client's requests."""

    def __init__(self, guard: Guard, client: Client) -> None:
        self.guard = guard
        self._client = client
        self._bytes = 0
        self._counted = False

    def enter(self) -> None:
        """Take a place among the client's requests."""
        most = self.guard.settings.max_client_requests
        if self._client.requests >= most:
            raise self.guard.refusal(429, "client", f"one client may have {most} requests answered at once")
        self._client.requests += 1
        self._counted = True

    def reserve(self, count: int) -> None:
        """Note that ``count`` bytes are held until the answer is sent; from any thread."""
        most = self.guard.settings.max_buffered_bytes
        if count > most:
            raise Problem(413, f"an answer may have {most} bytes, this one would have {count}; ask for fewer frames")
        self.guard.buffer(count)
        self._bytes += count

    async def read(self, request: Request) -> bytes:
        """The body of ``request``, counted as it streams in; raises Problem where it is too large, slow or encoded."""
        settings = self.guard.settings
        encoding = request.headers.get("content-encoding", "identity").strip().lower()
        if encoding not in ("", "identity"):
            raise Problem(
                415, f"request bodies must not be compressed, got content-encoding {encoding[:64]!r}",
                {"accept-encoding": "identity"},
            )  # fmt: skip
        self.enter()
        body = bytearray()
        try:
            with anyio.fail_after(settings.body_seconds):
                async for chunk in request.stream():
                    if len(body) + len(chunk) > settings.max_body_bytes:
                        raise Problem(
                            413, f"a request body may have {settings.max_body_bytes} bytes; send the motion in parts"
                        )
                    self.reserve(len(chunk))
                    body += chunk
        except ClientDisconnect:
            raise Problem(400, "the client was gone before its body was there") from None
        except TimeoutError:
            self.guard.metrics.refused.labels("slow_body").inc()
            raise Problem(
                408, f"a request body must be there within {settings.body_seconds:g} s", {"connection": "close"}
            ) from None
        return bytes(body)

    async def run(self, work: Callable[[], Answer]) -> Answer:
        """As :meth:`Guard.run`."""
        return await self.guard.run(work)

    def release(self) -> None:
        """Give everything back: the answer is sent, or nobody waits for it."""
        self.guard.buffer(-self._bytes)
        self._bytes = 0
        if self._counted:
            self._client.requests -= 1
            self._counted = False


class Guarded:
    """Middleware: counts every request towards its client's rate, and gives back what a request held at its end."""

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self._app = app
        self._guard = guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; WebSocket messages are counted by the stream itself."""
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        client = self._guard.client((scope.get("client") or ("unknown", 0))[0])
        try:
            if scope["path"] not in ALWAYS_ANSWERED:
                self._guard.count_request(client)
        except Problem as problem:
            refused = problem_response(problem.status, str(problem), problem.headers, scope["path"])
            return await refused(scope, receive, send)
        hold = scope.setdefault("state", {})["hold"] = Hold(self._guard, client)
        try:
            return await self._app(scope, receive, send)
        finally:
            hold.release()


def hold_of(request: Request) -> Hold:
    """What the request holds; everything is given back at its end."""
    return request.state.hold


async def _entered(request: Request) -> Hold:
    """In the event loop, for places are not counted by several threads."""
    hold = hold_of(request)
    hold.enter()
    return hold


Entered = Annotated[Hold, Depends(_entered)]
"""Of a route without a body: what its request holds, which has taken a place among its client's."""
