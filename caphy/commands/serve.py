"""``caphy serve``."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from pathlib import Path

import tyro

from caphy.errors import CaphyError


@dataclass(frozen=True)
class Serve:
    """Serve avatars over HTTP. Environment variables CAPHY_... set what is not given here (see service/settings.py)."""

    avatars: Path | None = None
    """Folder of avatar bundles, or one bundle; by default the one that comes with the package."""
    host: str | None = None
    """Address to listen on; by default this machine only."""
    port: int | None = None
    """Port to listen on; 8000 by default, 0 for any that is free."""


def main(arguments: list[str]) -> None:
    """Run ``caphy serve`` with the arguments after it; returns when the service is stopped."""
    command = tyro.cli(Serve, prog="caphy serve", args=arguments)

    import uvicorn

    from service.app import create_app
    from service.avatars import load_avatars
    from service.settings import read_settings

    given = {name: value for name, value in vars(command).items() if value is not None}
    settings = read_settings(**given)
    avatars = load_avatars(settings.avatars, settings.chunk_frames)
    listener = _listen(settings.host, settings.port)
    port = listener.getsockname()[1]
    print(f"serving {', '.join(avatars)} on http://{settings.host}:{port} (API: /docs)", flush=True)
    config = uvicorn.Config(create_app(settings, avatars), log_level="warning")
    uvicorn.Server(config).run(sockets=[listener])


def _listen(host: str, port: int) -> socket.socket:
    """A listening socket; connections made from now on wait for the service."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=2048)
    except OSError as error:
        reason = error.strerror or error
        raise CaphyError(f"cannot listen on {host}, port {port} ({reason}); choose another with --port") from error
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # inherited; without it small answers wait 40 ms
    return listener
