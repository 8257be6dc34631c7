"""The HTTP application. Start it with ``caphy serve``, or ``uvicorn --factory service.app:create_app``."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
from fastapi import FastAPI

import caphy
from service import problem
from service.avatar_routes import add_avatars
from service.avatars import Avatar, load_avatars
from service.frames_route import add_frames
from service.problem import Problem
from service.settings import Settings, read_settings


def create_app(settings: Settings | None = None, avatars: dict[str, Avatar] | None = None) -> FastAPI:
    """The application; avatars that are not given are loaded, and errors in them raised, when it starts."""
    settings = settings or read_settings()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.state.avatars = avatars or load_avatars(settings.avatars, settings.chunk_frames)
        yield

    app = FastAPI(title="caphy", version=caphy.__version__, lifespan=lifespan)
    app.state.avatars = {}
    app.state.settings = settings
    app.state.limiter = anyio.CapacityLimiter(settings.threads)
    problem.install(app)
    _add_health(app)
    add_avatars(app)
    add_frames(app)
    return app


def _add_health(app: FastAPI) -> None:
    @app.get("/health")
    async def health() -> dict[str, str]:
        """The process answers."""
        return {"status": "ok", "version": caphy.__version__}

    @app.get("/ready", responses={503: {"description": "avatars are still loading"}})
    async def ready() -> dict[str, str]:
        """Avatars are loaded and warm."""
        if not app.state.avatars:
            raise Problem(503, "avatars are still loading")
        return {"status": "ready"}
