"""``/`` and what its page needs beyond the other routes: static files, and pose files turned into poses."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import FastAPI, Query, Request, Response
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles

from caphy.io.poses import PoseSequence, placed_on
from caphy.io.procedural import procedural_motion
from service import protocol
from service.answers import PartsResponse
from service.avatar_routes import LIMITS, NOT_FOUND, AvatarId, find_avatar, require_known
from service.guard import Entered, Hold, hold_of
from service.settings import Settings
from service.viewer.pose_files import frames_request, read_upload

STATIC: Final = Path(__file__).parent / "static"
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data: blob:; "
    "base-uri 'none'; form-action 'none'"
)
"""The page loads nothing from anywhere else, and runs nothing but its own files."""
MADE_UP_SECONDS: Final = 20.0
PROBLEMS: Final[dict[int | str, dict[str, Any]]] = {
    status: {"description": text, "content": {"application/problem+json": {}}}
    for status, text in {
        401: "the service wants a key",
        404: "no such avatar",
        408: "the file took too long",
        413: "too many bytes, or too long a motion",
        415: "not a pose file of a format that is read here",
        422: "the file cannot be read; `detail` says why",
        429: "one client asks for too much; `retry-after` says when to try again",
        503: "the service is at its limit, and `retry-after` says when to try again; or it can write no temporary file",
    }.items()
}
POSES: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "content": {protocol.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}},
        "description": "the body of a binary frames request; headers caphy-source and caphy-notes hold JSON",
    }
}
UPLOAD: Final = {
    "requestBody": {
        "required": True,
        "content": {protocol.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}},
    }
}


class _Files(StaticFiles):
    """Files that a browser asks for again after an update: it keeps them, but checks."""

    def file_response(self, *args: Any, **options: Any) -> Response:
        response = super().file_response(*args, **options)
        response.headers["cache-control"] = "no-cache"
        response.headers["x-content-type-options"] = "nosniff"
        return response


def add_viewer(app: FastAPI) -> None:
    """Mount the page, its files and its routes."""
    app.mount("/viewer", _Files(directory=STATIC), name="viewer")

    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        headers = {"content-security-policy": POLICY, "referrer-policy": "no-referrer", "cache-control": "no-cache"}
        return FileResponse(STATIC / "index.html", headers=headers)

    @app.get("/avatars/{avatar}/poses", responses={**POSES, **NOT_FOUND, **LIMITS}, response_class=Response)
    async def made_up(request: Request, hold: Entered, avatar: AvatarId) -> Response:
        """A made-up motion of 20 s for a first look, at the avatar's frame rate: the body of a frames request."""
        require_known(request)
        bundle = find_avatar(request, avatar).bundle
        sole = float(bundle.body.vertices[:, 1].min())
        return await hold.run(lambda: _answer(request, hold, placed_on(_made_up(bundle.fps), bundle.joints, sole)))

    app.post(
        "/avatars/{avatar}/poses",
        responses={**POSES, **PROBLEMS},
        openapi_extra=UPLOAD,
        response_class=Response,
    )(post_poses)


async def post_poses(
    request: Request,
    avatar: AvatarId,
    name: Annotated[str, Query(max_length=255, description="the file's name; its ending tells the format")],
    fps: Annotated[float | None, Query(ge=1, le=1000, description="true frame rate, where the file has none")] = None,
) -> Response:
    """A pose file (.npz of AMASS, SMPL-X or caphy; .bvh of CMU) as this avatar's poses: a frames request's body."""
    require_known(request, "name", "fps")
    bundle = find_avatar(request, avatar).bundle
    hold = hold_of(request)
    content = await hold.read(request)

    def work() -> Response:
        return _answer(request, hold, read_upload(name, content, bundle, fps))

    return await hold.run(work)


@lru_cache(maxsize=4)
def _made_up(fps: float) -> PoseSequence:
    return procedural_motion(seconds=MADE_UP_SECONDS, fps=fps)


def _answer(request: Request, hold: Hold, sequence: PoseSequence) -> Response:
    settings: Settings = request.app.state.settings
    body, headers = frames_request(sequence)
    hold.reserve(len(body))
    return PartsResponse([body], protocol.MEDIA_TYPE, settings.send_seconds, headers)
