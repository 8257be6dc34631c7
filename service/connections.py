"""Connections: how many there may be, how long a request's header may take, and when the kernel gives one up."""

from __future__ import annotations

import asyncio
import socket
from typing import Any, Final

from uvicorn.protocols.http.h11_impl import H11Protocol

from caphy.errors import CaphyError
from service.settings import Settings

BACKLOG: Final = 2048
KEEPALIVE: Final = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}
"""A peer that is silent for 30 s is asked three times whether it is still there [s, s, times]."""
FULL: Final = (
    b"HTTP/1.1 503 Service Unavailable\r\ncontent-type: text/plain\r\ncontent-length: 26\r\n"
    b"retry-after: 1\r\nconnection: close\r\n\r\nthere are too many clients"
)


def listen(settings: Settings) -> socket.socket:
    """A listening socket; connections made from now on wait for the service.

    Raises CaphyError where the address cannot be had.
    """
    host, port = settings.host, settings.port
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        both = host == "::" and socket.has_dualstack_ipv6()  # all of this machine's addresses, those of IPv4 as well
        listener = socket.create_server((host, port), family=family, backlog=BACKLOG, dualstack_ipv6=both)
    except OSError as error:
        reason = error.strerror or error
        raise CaphyError(f"cannot listen on {host}, port {port} ({reason}); choose another with --port") from error
    set_options(listener, settings)
    return listener


def set_options(listener: socket.socket, settings: Settings) -> None:
    """What every accepted connection inherits: small answers leave at once, and dead peers are given up."""
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # without it small answers wait 40 ms
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in KEEPALIVE.items():
        if option := getattr(socket, name, None):
            listener.setsockopt(socket.IPPROTO_TCP, option, value)
    if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; also ends connections whose peer has stopped reading
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1e3 * settings.send_seconds))


def guarded_protocol(settings: Settings) -> type[H11Protocol]:
    """The protocol class for uvicorn, with these limits."""

    class Limited(GuardedProtocol):
        header_seconds = settings.header_seconds
        max_connections = settings.max_connections

    return Limited


class GuardedProtocol(H11Protocol):
    """HTTP/1.1 that closes a connection whose next request's header does not arrive in time.

    uvicorn itself waits for ever for the first request, and for the rest of one that has begun.
    """

    header_seconds: float
    max_connections: int
    _header_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client is there."""
        super().connection_made(transport)
        if len(self.connections) > self.max_connections:
            transport.write(FULL)
            transport.close()
            return
        self._set_timer()

    def data_received(self, data: bytes) -> None:
        """Bytes have come."""
        super().data_received(data)
        if self._is_between_requests():
            self._set_timer()
        else:
            self._drop_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """The client is gone."""
        self._drop_timer()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event: Any) -> None:
        """From now on the connection is a WebSocket's."""
        self._drop_timer()
        super().handle_websocket_upgrade(event)

    def _is_between_requests(self) -> bool:
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            return False
        return self.cycle is None or self.cycle.response_complete

    def _set_timer(self) -> None:
        if self._header_timer is None:
            self._header_timer = self.loop.call_later(self.header_seconds, self._give_up)

    def _drop_timer(self) -> None:
        if self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None

    def _give_up(self) -> None:
        self._header_timer = None
        if self._is_between_requests():
            self.transport.abort()
