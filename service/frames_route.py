"""``POST /avatars/{avatar}/frames``: poses in, garment meshes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Final

from fastapi import FastAPI, Query, Request, Response

from service import frames, protocol
from service.answers import PartsResponse
from service.avatar_routes import AvatarId, find_avatar, require_known
from service.conditioned import OFF, body_of, conditioned, header, parse_settings, require_conditionable
from service.encodings import EncodingName
from service.engine import GarmentEngine
from service.errors import Problem
from service.guard import hold_of
from service.metrics import Metrics, Stages
from service.settings import Settings

JSON_MEDIA_TYPE = "application/json"
FLOAT_BYTES: Final = 4
TEXT_BYTES: Final = 10
"""Of a number in JSON, rounded to a hundredth of a millimetre."""
PARAMETERS: Final = ("garment", "encoding", "normals", "condition")
"""Of the query."""
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
        401: "the service wants a key",
        404: "no such avatar or garment",
        406: "answers are JSON or octet-stream",
        408: "the body took too long",
        413: "too many frames or bytes",
        415: "requests are JSON or octet-stream",
        422: "the poses cannot be used; `detail` says why",
        429: "one client asks for too much; `retry-after` says when to try again",
        503: "the service is at its limit; `retry-after` says when to try again",
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
    condition: Annotated[str, Query(description="condition noisy poses: on, off, or settings in JSON")] = OFF,
) -> Response:
    """Garment meshes for a pose sequence: JSON or binary (docs/protocol.md), like the request or as `Accept` asks."""
    settings: Settings = request.app.state.settings
    metrics: Metrics = request.app.state.metrics
    hold = hold_of(request)
    require_known(request, *PARAMETERS)
    found = find_avatar(request, avatar)
    engines = found.select(garment)
    sent = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if sent not in (JSON_MEDIA_TYPE, protocol.MEDIA_TYPE):
        raise Problem(415, f"content-type must be {JSON_MEDIA_TYPE} or {protocol.MEDIA_TYPE}, got {sent or 'none'!r}")
    wanted = _answer_type(",".join(request.headers.getlist("accept")), sent)
    packing = frames.Wanted.of(encoding, normals)
    if wanted == JSON_MEDIA_TYPE and packing != frames.Wanted():
        raise Problem(422, f"encoding and normals are for binary answers; ask for {protocol.MEDIA_TYPE} by accept")
    asked = parse_settings(condition, found.bundle.fps)
    body = await hold.read(request)

    def work() -> Response:
        stages = Stages(metrics.stage_seconds)
        with stages.time("parse"):
            if sent == JSON_MEDIA_TYPE:
                parsed = frames.parse_json(body, engines, settings.max_frames)
            else:
                parsed = protocol.decode_request(body)
                parsed = replace(parsed, fps=frames.same_rate(parsed.fps, found.bundle.fps))
            require_conditionable(parsed, asked)
            frames.require_valid(parsed, settings, found.bundle.fps, engines)
            count = frames.answered_frames(parsed, found.bundle.fps)
            if wanted == JSON_MEDIA_TYPE and asked is None:
                require_few_frames(count, settings)
            hold.reserve(count * answer_bytes(engines, as_text=wanted == JSON_MEDIA_TYPE))
            conditions = None if asked is None else conditioned(parsed, asked, body_of(found.bundle))
            if conditions is not None:
                count = len(conditions.poses)
            if wanted == JSON_MEDIA_TYPE:
                require_few_frames(count, settings)
        with stages.time("infer"):
            answered = frames.answer(parsed, engines, found.bundle.fps, packing, found.bundle.joints[0], conditions)
        with stages.time("encode"):
            parts = [frames.json_answer(answered)] if wanted == JSON_MEDIA_TYPE else protocol.encode_response(answered)
        metrics.frames.labels(found.id).inc(count)
        told = {"server-timing": stages.server_timing, **header(answered.conditioning)}
        return PartsResponse(parts, wanted, settings.send_seconds, told)

    return await hold.run(work)


def _answer_type(accept: str, sent: str) -> str:
    """Of what a client accepts what it likes best (RFC 9110, 12.5.1), of those alike what is like the request."""
    liked: dict[str, float] = {}
    for part in accept.split(",") if accept.strip() else ["*/*"]:
        name, *parameters = (each.strip().lower() for each in part.split(";"))
        liked[name] = next((_quality(each[2:]) for each in parameters if each.startswith("q=")), 1.0)
    every = liked.get("application/*", liked.get("*/*", 0.0))
    best = {name: liked.get(name, every) for name in (sent, protocol.MEDIA_TYPE, JSON_MEDIA_TYPE)}
    chosen = max(best, key=lambda name: best[name])
    if best[chosen] > 0:
        return chosen
    raise Problem(406, f"answers are {JSON_MEDIA_TYPE} or {protocol.MEDIA_TYPE}, accept asks for {accept[:100]!r}")


def _quality(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 1.0


def require_few_frames(count: int, settings: Settings) -> None:
    """Raise Problem where so many frames are too many to be answered as JSON."""
    if count > settings.max_json_frames:
        raise Problem(
            413,
            f"at most {settings.max_json_frames} frames are answered as JSON, and these poses make {count}; "
            "ask for a binary answer (octet-stream), or send fewer",
        )


def answer_bytes(engines: Sequence[GarmentEngine], as_text: bool) -> int:
    """About how many bytes one frame of an answer takes in memory."""
    numbers = 3 * sum(engine.vertex_count for engine in engines)
    return numbers * (TEXT_BYTES if as_text else FLOAT_BYTES)
