"""``caphy serve``."""

from __future__ import annotations

import logging.config
import os
import signal
import socket
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

if TYPE_CHECKING:
    from service.report import Report
    from service.settings import Settings


@dataclass(frozen=True)
class Serve:
    """Serve avatars over HTTP. Environment variables CAPHY_... set what is not given here (see docs/operation.md)."""

    avatars: Path | None = None
    """Folder of avatar bundles, or one bundle; by default the one that comes with the package."""
    host: str | None = None
    """Address to listen on; by default this machine only. Others need a key in CAPHY_API_KEY."""
    port: int | None = None
    """Port to listen on; 8000 by default, 0 for any that is free."""
    workers: int | None = None
    """Processes that share the port; one by default. As many as there are cores is a good number."""


def main(arguments: list[str]) -> None:
    """Run ``caphy serve`` with the arguments after it; returns when the service is stopped."""
    command = tyro.cli(Serve, prog="caphy serve", args=arguments)

    from service.connections import listen
    from service.logs import log_config
    from service.settings import read_settings

    settings = read_settings(**{name: value for name, value in vars(command).items() if value is not None})
    settings.require_key_beyond_loopback()
    logging.config.dictConfig(log_config(settings.log_level))
    if settings.workers > 1:
        _serve_by_workers(settings, listen(settings))
    else:
        _serve(settings)


def _serve(settings: Settings) -> None:
    from service.app import create_app
    from service.connections import listen
    from service.report import make_report
    from service.server import make_server

    app = create_app(settings)
    app.state.library.load()
    listener = listen(settings)
    _say(settings, listener, make_report(app.state.library.avatars))
    signal.signal(signal.SIGTERM, lambda *_: _leave())  # uvicorn finishes its work, then hands the signal on
    make_server(app, settings).run(sockets=[listener])


def _leave() -> None:
    """End at once: threads that still compute what was cut off would be waited for."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _serve_by_workers(settings: Settings, listener: socket.socket) -> None:
    from service.workers import Workers

    Workers(listener, settings).run(lambda report: _say(settings, listener, report))


def _say(settings: Settings, listener: socket.socket, report: Report) -> None:
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    url = f"http://{host}:{listener.getsockname()[1]}"
    shared = f" with {settings.workers} workers" if settings.workers > 1 else ""
    print(f"serving {', '.join(report.avatars)} on {url}{shared} (API: /docs)")
    print(*report.lines(), sep="\n", flush=True)
