"""The HTTP server of one process: uvicorn with our limits, our logs, and a stop that finishes what is in flight."""

from __future__ import annotations

import logging
import resource
import socket

import uvicorn
from fastapi import FastAPI

from service.connections import BACKLOG, guarded_protocol
from service.logs import log_config
from service.settings import Settings

log = logging.getLogger("caphy.service")


class Server(uvicorn.Server):
    """Accepts one connection per turn of its loop, so that several processes share what comes in a burst."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Load what is not loaded, and listen."""
        await super().startup(sockets)
        for listener in sockets or []:
            listener.listen(BACKLOG)  # uvicorn's own backlog is also how many connections are accepted in one turn
        log.info("ready")

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept nothing more, finish what is in flight."""
        log.info("stopping")
        await super().shutdown(sockets)
        log.info("stopped")


def make_server(app: FastAPI, settings: Settings) -> Server:
    """The server of ``app``; run it on a socket of :func:`service.connections.listen`."""
    _allow_open_files(settings.max_connections)
    logging.captureWarnings(True)  # NumPy's too are lines of the log
    config = uvicorn.Config(
        app,
        http=guarded_protocol(settings),
        ws_max_size=settings.max_body_bytes,
        ws_per_message_deflate=False,  # what is small may unpack to much
        log_config=log_config(settings.log_level),
        access_log=False,
        server_header=False,
        backlog=1,
        timeout_graceful_shutdown=settings.drain_seconds,
    )
    return Server(config)


def _allow_open_files(connections: int) -> None:
    """Raise the soft limit of open files so far that every connection can have one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = connections + 200
    if soft != resource.RLIM_INFINITY and soft < needed:
        most = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
