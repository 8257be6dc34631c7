"""The HTTP application. Start it with ``caphy serve``, or ``uvicorn --factory service.app:create_app``."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
from fastapi import FastAPI
from fastapi.middleware.cors import CORSMiddleware

import caphy
from service import problem
from service.avatar_routes import add_avatars
from service.described import describe_errors
from service.endpoints_page import add_endpoints_page
from service.frames_route import add_frames
from service.guard import Guard, Guarded
from service.heads import Heads
from service.health import add_health
from service.keys import RequireKey, Subprotocol
from service.library import Library
from service.metrics import Metrics, add_metrics
from service.observe import Observed
from service.openinference.routes import add_open_inference
from service.settings import Settings, read_settings
from service.stream.routes import add_stream
from service.viewer.routes import add_viewer

PUBLIC = ("/", "/viewer/")
"""Paths that need no key: the viewer's page and its files, which hold nothing of avatars. Folders end with a slash."""


def create_app(settings: Settings | None = None) -> FastAPI:
    """The application; avatars that are not loaded yet are loaded, and errors in them raised, when it starts.

    ``app.state`` holds settings, library, metrics and guard for every route.
    """
    settings = settings or read_settings()
    metrics = Metrics()
    library = Library(settings.avatars, settings.chunk_frames, metrics)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        if not library.avatars:
            await anyio.to_thread.run_sync(library.load)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(metrics.watch_memory)
            if settings.reload_seconds:
                tasks.start_soon(library.watch, settings.reload_seconds)
            yield
            tasks.cancel_scope.cancel()

    app = FastAPI(title="caphy", version=caphy.__version__, lifespan=lifespan, docs_url=None, redoc_url=None)
    app.state.settings = settings
    app.state.library = library
    app.state.metrics = metrics
    app.state.guard = Guard(settings, metrics)
    problem.install(app)
    add_endpoints_page(app)
    add_health(app)
    add_avatars(app)
    add_frames(app)
    add_stream(app)
    add_open_inference(app)
    add_metrics(app, metrics)
    add_viewer(app)
    describe_errors(app)
    _add_middleware(app, settings)
    return app


def _add_middleware(app: FastAPI, settings: Settings) -> None:
    """The one added last is the outermost: requests are let in from other pages, observed, counted, asked for the key,
    in this order."""
    app.add_middleware(Heads, except_below="/viewer/")
    app.add_middleware(Subprotocol)
    if keys := settings.api_keys():
        app.add_middleware(RequireKey, keys=keys, public=PUBLIC)
    app.add_middleware(Guarded, guard=app.state.guard)
    app.add_middleware(Observed, metrics=app.state.metrics)
    if origins := settings.allowed_origins():  # outside of what refuses or fails, so that pages may read why
        app.add_middleware(
            CORSMiddleware, allow_origins=origins, allow_methods=["GET", "HEAD", "POST"], allow_headers=["*"],
            expose_headers=["*"],
        )  # fmt: skip
