"""``caphy serve``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Serve:
    """Serve avatars over HTTP. Environment variables CAPHY_... set what is not given here (see service/settings.py)."""

    avatars: Path | None = None
    """Folder of avatar bundles, or one bundle; by default the one that comes with the package."""
    host: str | None = None
    """Address to listen on; by default this machine only."""
    port: int | None = None
    """Port to listen on; 8000 by default."""


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
    print(f"serving {', '.join(avatars)} on http://{settings.host}:{settings.port} (API: /docs)", flush=True)
    uvicorn.run(create_app(settings, avatars), host=settings.host, port=settings.port, log_level="warning")
