"""``/avatars/{avatar}/stream``: the WebSocket of docs/stream.md."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from fastapi import FastAPI, WebSocket

from caphy.errors import CaphyError
from service.avatar_routes import find_avatar
from service.errors import Problem
from service.metrics import Metrics, Stages
from service.stream.connection import Connection, StreamError, answered
from service.stream.feeds import add_feeds
from service.stream.limits import StreamLimits, read_limits
from service.stream.messages import Hello, decode_client, encode_welcome
from service.stream.scheduler import Scheduler
from service.stream.session import Session


class Streams:
    """The streams of one process, counted in all and by client."""

    def __init__(self, limits: StreamLimits, metrics: Metrics) -> None:
        self.limits = limits
        self.scheduler = Scheduler(Stages(metrics.stream_seconds))
        self._clients: Counter[str] = Counter()
        self._metrics = metrics

    @contextmanager
    def place(self, client: str) -> Iterator[None]:
        """A place for one stream of a client; raises StreamError where there is none."""
        if self._clients.total() >= self.limits.max_streams:
            raise StreamError(503, f"the service holds {self.limits.max_streams} streams, its limit; try again later")
        if self._clients[client] >= self.limits.max_client_streams:
            raise StreamError(429, f"one client may hold {self.limits.max_client_streams} streams; close one first")
        self._count(client, 1)
        try:
            yield
        finally:
            self._count(client, -1)

    def _count(self, client: str, change: int) -> None:
        self._clients[client] += change
        if not self._clients[client]:
            del self._clients[client]
        self._metrics.streams.inc(change)


def add_stream(app: FastAPI, limits: StreamLimits | None = None) -> None:
    """Mount the stream; limits that are not given are read from the environment."""
    streams = Streams(limits or read_limits(), app.state.metrics)

    @app.websocket("/avatars/{avatar}/stream")
    async def stream(websocket: WebSocket, avatar: str) -> None:
        async def serve() -> None:
            with streams.place(websocket.client.host if websocket.client else ""):
                await _serve(websocket, avatar, streams)

        await answered(websocket, serve)

    add_feeds(app, streams.limits)


async def _serve(websocket: WebSocket, avatar: str, streams: Streams) -> None:
    connection = Connection(websocket, streams.limits)
    hello = await _hello(connection, streams.limits)
    try:
        session = Session(find_avatar(websocket, avatar), hello, streams.limits)
    except Problem as problem:
        raise StreamError(problem.status, str(problem)) from problem
    connection.post(encode_welcome(session.welcome()))
    await connection.run(session, streams.scheduler)


async def _hello(connection: Connection, limits: StreamLimits) -> Hello:
    try:
        async with asyncio.timeout(limits.hello_seconds):
            body = await connection.receive()
    except TimeoutError:
        raise StreamError(408, f"hello must come within {limits.hello_seconds:g} s") from None
    try:
        message = decode_client(body)
    except CaphyError as error:
        raise StreamError(400, str(error)) from error
    if not isinstance(message, Hello):
        raise StreamError(409, "the first message must be hello")
    return message
