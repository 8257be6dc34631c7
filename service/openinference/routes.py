"""The endpoints under ``/v2``."""

from __future__ import annotations

from typing import Annotated, Any, Final

from fastapi import APIRouter, FastAPI, Path, Request, Response
from fastapi.responses import JSONResponse

import caphy
from service import frames
from service.answers import PartsResponse
from service.frames_route import answer_bytes, require_few_frames
from service.guard import hold_of
from service.metrics import Metrics, Stages
from service.openinference import messages
from service.openinference.models import OUTPUTS, Model, find_model
from service.settings import Settings

ModelName = Annotated[str, Path(description="AVATAR.GARMENT, of those that GET /avatars lists")]
ModelVersion = Annotated[str, Path(description="the version that the model's metadata names")]
ERRORS: Final[dict[int | str, dict[str, Any]]] = {
    status: {"description": text, "model": messages.Error}
    for status, text in {
        400: "the request cannot be used; `error` says why",
        401: "the service wants a key",
        404: "no such model or version",
        408: "the body took too long",
        413: "too many frames or bytes",
        415: "bodies must not be compressed",
        429: "one client asks for too much; `retry-after` says when to try again",
        503: "the service is at its limit; `retry-after` says when to try again",
    }.items()
}
GET_ERRORS: Final[dict[int | str, dict[str, Any]]] = {status: ERRORS[status] for status in (400, 401, 404, 429, 503)}
"""Of what has no body."""
TENSORS: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "description": "tensors as JSON, or the binary extension's",
        "content": {
            "application/json": {},
            "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
        },
    }
}
INFER_BODY: Final = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {"schema": messages.request_schema()},
            "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
        },
    }
}
router = APIRouter(prefix="/v2", tags=["Open Inference Protocol"])


def add_open_inference(app: FastAPI) -> None:
    """Mount the endpoints."""
    app.include_router(router)


@router.get("")
async def server_metadata() -> dict[str, Any]:
    """Name, version and extensions of the server."""
    return {"name": "caphy", "version": caphy.__version__, "extensions": ["binary_tensor_data"]}


@router.get("/health/live")
async def live() -> dict[str, bool]:
    """The process answers."""
    return {"live": True}


@router.get("/health/ready", responses={503: {"description": "avatars are still loading"}})
async def ready(request: Request) -> JSONResponse:
    """All models are loaded and warm."""
    loaded = bool(request.app.state.library.avatars)
    return JSONResponse({"ready": loaded}, 200 if loaded else 503)


@router.get("/models/{model}", responses=GET_ERRORS)
@router.get("/models/{model}/versions/{version}", responses=GET_ERRORS)
async def model_metadata(request: Request, model: ModelName, version: ModelVersion | None = None) -> dict[str, Any]:
    """Versions and tensors of a model."""
    return _find(request, model, version).metadata()


@router.get("/models/{model}/ready", responses=GET_ERRORS)
@router.get("/models/{model}/versions/{version}/ready", responses=GET_ERRORS)
async def model_ready(request: Request, model: ModelName, version: ModelVersion | None = None) -> dict[str, Any]:
    """The model is loaded and warm."""
    return {"name": _find(request, model, version).name, "ready": True}


@router.post("/models/{model}/infer", responses=TENSORS | ERRORS, openapi_extra=INFER_BODY, response_class=Response)
@router.post(
    "/models/{model}/versions/{version}/infer",
    responses=TENSORS | ERRORS,
    openapi_extra=INFER_BODY,
    response_class=Response,
)
async def infer(request: Request, model: ModelName, version: ModelVersion | None = None) -> Response:
    """Vertices of the garment for poses, and the state to continue with."""
    settings: Settings = request.app.state.settings
    metrics: Metrics = request.app.state.metrics
    hold = hold_of(request)
    found = _find(request, model, version)
    body = await hold.read(request)
    header_length = request.headers.get(messages.HEADER_LENGTH)

    def work() -> Response:
        stages = Stages(metrics.stage_seconds)
        with stages.time("parse"):
            asked, tensors = messages.decode(body, header_length, settings.max_frames, found.engine.state_size)
            wanted = asked.wanted(OUTPUTS)
            parsed = found.request(asked, tensors)
            fps = found.avatar.bundle.fps
            frames.require_valid(parsed, settings, fps, [found.engine])
            count = frames.answered_frames(parsed, fps)
            as_text = not wanted.get("vertices", True)
            if as_text:
                require_few_frames(count, settings)
            hold.reserve(count * answer_bytes([found.engine], as_text))
        with stages.time("infer"):
            outputs = found.infer(parsed)
        with stages.time("encode"):
            head = {"model_name": found.name, "model_version": found.avatar.version}
            head |= {} if asked.id is None else {"id": asked.id}
            parts, headers = messages.encode(head, outputs, wanted)
        metrics.frames.labels(found.avatar.id).inc(count)
        headers["server-timing"] = stages.server_timing
        return PartsResponse(parts, headers.pop("content-type"), settings.send_seconds, headers)

    return await hold.run(work)


def _find(request: Request, model: str, version: str | None) -> Model:
    return find_model(request.app.state.library.avatars, model, version)
