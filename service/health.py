"""Probes: the process answers; its avatars are loaded and warm."""

from __future__ import annotations

from fastapi import FastAPI

import caphy
from service.errors import Problem


def add_health(app: FastAPI) -> None:
    """Mount ``/health`` and ``/ready``."""

    @app.get("/health")
    async def health() -> dict[str, str]:
        """The process answers."""
        return {"status": "ok", "version": caphy.__version__}

    @app.get(
        "/ready",
        responses={503: {"description": "avatars are still loading", "content": {"application/problem+json": {}}}},
    )
    async def ready() -> dict[str, str]:
        """Avatars are loaded and warm."""
        if not app.state.library.avatars:
            raise Problem(503, "avatars are still loading", {"retry-after": "1"})
        return {"status": "ready"}
