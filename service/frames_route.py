"""``POST /avatars/{avatar}/frames``: poses in, garment meshes out."""

from __future__ import annotations

import time
from typing import Annotated, Any

import anyio
import anyio.to_thread
from fastapi import FastAPI, Query, Request, Response

from service import frames, protocol
from service.avatar_routes import AvatarId, find_avatar
from service.encodings import EncodingName
from service.problem import Problem
from service.settings import Settings

JSON_MEDIA_TYPE = "application/json"
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


def add_frames(app: FastAPI) -> None:
    """Mount the route."""
    app.post(
        "/avatars/{avatar}/frames",
        responses={200: {"content": {protocol.MEDIA_TYPE: {}, JSON_MEDIA_TYPE: {}}}, **PROBLEMS},
        openapi_extra=FRAMES_BODY,
        response_class=Response,
    )(post_frames)


async def post_frames(
    request: Request,
    avatar: AvatarId,
    garment: Annotated[list[str], Query(description="garments to answer; all where none is named")] = [],  # noqa: B006
    encoding: Annotated[EncodingName, Query(description="how binary answers pack the meshes")] = "float32",
    normals: Annotated[bool, Query(description="binary answers hold vertex normals too")] = False,
) -> Response:
    """Garment meshes for a pose sequence: JSON or binary (docs/protocol.md), like the request or as `Accept` asks."""
    settings: Settings = request.app.state.settings
    found = find_avatar(request, avatar)
    engines = found.select(garment)
    sent = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if sent not in (JSON_MEDIA_TYPE, protocol.MEDIA_TYPE):
        raise Problem(415, f"content-type must be {JSON_MEDIA_TYPE} or {protocol.MEDIA_TYPE}, got {sent or 'none'!r}")
    wanted = _answer_type(request.headers.get("accept", "*/*"), sent)
    packing = frames.Wanted.of(encoding, normals)
    if wanted == JSON_MEDIA_TYPE and packing != frames.Wanted():
        raise Problem(422, f"encoding and normals are for binary answers; ask for {protocol.MEDIA_TYPE} by accept")
    body = await _read(request, settings.max_body_bytes)

    def work() -> Response:
        started = time.perf_counter()
        parsed = frames.parse_json(body, engines) if sent == JSON_MEDIA_TYPE else protocol.decode_request(body)
        frames.require_valid(parsed, settings, found.bundle.fps, sum(engine.state_size for engine in engines))
        if wanted == JSON_MEDIA_TYPE:
            _require_few_frames(len(parsed.poses) * found.bundle.fps / parsed.fps, settings)
        read = time.perf_counter()
        answered = frames.answer(parsed, engines, found.bundle.fps, packing, found.bundle.joints[0])
        inferred = time.perf_counter()
        response = _encode(answered, wanted)
        encoded = time.perf_counter()
        stages = {"parse": read - started, "infer": inferred - read, "encode": encoded - inferred}
        response.headers["server-timing"] = ", ".join(f"{k};dur={1e3 * v:.3f}" for k, v in stages.items())
        return response

    return await anyio.to_thread.run_sync(work, limiter=request.app.state.limiter)


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
