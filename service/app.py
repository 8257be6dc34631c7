"""The HTTP application. Start it with ``caphy serve``, or ``uvicorn --factory service.app:create_app``."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated, Any, Literal

import anyio
import anyio.to_thread
from fastapi import FastAPI, Path, Query, Request, Response
from fastapi.responses import JSONResponse

import caphy
from service import frames, mesh, problem, protocol
from service.avatars import Avatar, load_avatars
from service.problem import Problem
from service.settings import Settings, read_settings

JSON_MEDIA_TYPE = "application/json"
AvatarId = Annotated[str, Path(description="an id that GET /avatars lists")]
FRAMES_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            JSON_MEDIA_TYPE: {"schema": frames.JsonRequest.model_json_schema()},
            protocol.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}},
        },
    }
}
PROBLEMS: dict[int | str, dict[str, Any]] = {
    status: {"description": text, "content": {"application/problem+json": {}}}
    for status, text in {
        404: "no such avatar or garment",
        406: "answers are JSON or octet-stream",
        413: "too many frames or bytes",
        415: "requests are JSON or octet-stream",
        422: "the poses cannot be used; `detail` says why",
    }.items()
}


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
    _add_avatars(app)
    app.post(
        "/avatars/{avatar}/frames",
        responses={200: {"content": {protocol.MEDIA_TYPE: {}, JSON_MEDIA_TYPE: {}}}, **PROBLEMS},
        openapi_extra=FRAMES_BODY,
        response_class=Response,
    )(post_frames)
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


def _add_avatars(app: FastAPI) -> None:
    @app.get("/avatars")
    async def avatars() -> list[dict[str, Any]]:
        """What there is to dress."""
        return [avatar.summary() for avatar in app.state.avatars.values()]

    @app.get("/avatars/{avatar}", responses={404: PROBLEMS[404]})
    async def describe(request: Request, avatar: AvatarId) -> dict[str, Any]:
        """One avatar: garments, joints, licence, provenance, metrics."""
        found = _find(request, avatar)
        bundle = found.bundle
        return {
            **found.summary(),
            "joints": bundle.joints.tolist(),
            "parents": bundle.parents.tolist(),
            "licence": bundle.licence,
            "provenance": dict(bundle.provenance),
            "metrics": dict(bundle.metrics),
        }

    @app.get(
        "/avatars/{avatar}/mesh",
        responses={200: {"content": {JSON_MEDIA_TYPE: {}, mesh.GLB_MEDIA_TYPE: {}}}, 404: PROBLEMS[404]},
        response_class=Response,
    )
    def static_mesh(request: Request, avatar: AvatarId, format: Literal["json", "glb"] = "json") -> Response:
        """Body and garments in T-pose: vertices, faces and regions as JSON, or a GLB."""
        bundle = _find(request, avatar).bundle
        if format == "glb":
            return Response(mesh.mesh_glb(bundle), media_type=mesh.GLB_MEDIA_TYPE)
        return JSONResponse(mesh.mesh_json(bundle))


async def post_frames(
    request: Request,
    avatar: AvatarId,
    garment: Annotated[list[str], Query(description="garments to answer; all where none is named")] = [],  # noqa: B006
) -> Response:
    """Garment meshes for a pose sequence: JSON or binary (docs/protocol.md), like the request or as `Accept` asks."""
    settings: Settings = request.app.state.settings
    found = _find(request, avatar)
    engines = found.select(garment)
    sent = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if sent not in (JSON_MEDIA_TYPE, protocol.MEDIA_TYPE):
        raise Problem(415, f"content-type must be {JSON_MEDIA_TYPE} or {protocol.MEDIA_TYPE}, got {sent or 'none'!r}")
    wanted = _answer_type(request.headers.get("accept", "*/*"), sent)
    body = await _read(request, settings.max_body_bytes)

    def work() -> Response:
        started = time.perf_counter()
        parsed = frames.parse_json(body, engines) if sent == JSON_MEDIA_TYPE else protocol.decode_request(body)
        frames.require_valid(parsed, settings, found.bundle.fps, sum(engine.state_size for engine in engines))
        if wanted == JSON_MEDIA_TYPE:
            _require_few_frames(len(parsed.poses) * found.bundle.fps / parsed.fps, settings)
        read = time.perf_counter()
        answered = frames.answer(parsed, engines, found.bundle.fps)
        inferred = time.perf_counter()
        response = _encode(answered, wanted)
        encoded = time.perf_counter()
        stages = {"parse": read - started, "infer": inferred - read, "encode": encoded - inferred}
        response.headers["server-timing"] = ", ".join(f"{k};dur={1e3 * v:.3f}" for k, v in stages.items())
        return response

    return await anyio.to_thread.run_sync(work, limiter=request.app.state.limiter)


def _find(request: Request, identifier: str) -> Avatar:
    avatars: dict[str, Avatar] = request.app.state.avatars
    if identifier not in avatars:
        raise Problem(404, f"there is no avatar {identifier[:64]!r}; there is {', '.join(avatars) or 'none'}")
    return avatars[identifier]


def _answer_type(accept: str, sent: str) -> str:
    accepted = {part.partition(";")[0].strip().lower() for part in accept.split(",")}
    if accepted & {"", "*/*", "application/*", sent}:
        return sent
    for media_type in (protocol.MEDIA_TYPE, JSON_MEDIA_TYPE):
        if media_type in accepted:
            return media_type
    raise Problem(406, f"answers are {JSON_MEDIA_TYPE} or {protocol.MEDIA_TYPE}, accept asks for {accept[:100]!r}")


async def _read(request: Request, limit: int) -> bytes:
    """The body, counted as it streams in."""
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > limit:
            raise Problem(413, f"a request body may have {limit} bytes; send the motion in parts")
    return bytes(body)


def _require_few_frames(frames_answered: float, settings: Settings) -> None:
    if frames_answered > settings.max_json_frames + 1:
        raise Problem(
            413,
            f"at most {settings.max_json_frames} frames are answered as JSON, got {frames_answered:.0f}; "
            f"ask for {protocol.MEDIA_TYPE}, or send fewer",
        )


def _encode(response: protocol.FramesResponse, media_type: str) -> Response:
    if media_type == JSON_MEDIA_TYPE:
        return Response(frames.json_answer(response), media_type=JSON_MEDIA_TYPE)
    return Response(b"".join(protocol.encode_response(response)), media_type=media_type)
