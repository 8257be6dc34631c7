"""``GET /avatars...``: what there is to dress."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from fastapi import FastAPI, Path, Query, Request, Response
from fastapi.requests import HTTPConnection

from caphy.io.bundle import AvatarBundle
from service import mesh
from service.answers import PartsResponse
from service.avatars import Avatar
from service.errors import Problem
from service.guard import Entered
from service.settings import Settings

AvatarId = Annotated[str, Path(description="an id that GET /avatars lists")]
NOT_FOUND: dict[int | str, dict[str, Any]] = {
    404: {"description": "no such avatar or garment", "content": {"application/problem+json": {}}}
}
LIMITS: dict[int | str, dict[str, Any]] = {
    status: {"description": text, "content": {"application/problem+json": {}}}
    for status, text in {
        413: "the answer has more bytes than may be held",
    }.items()
}
"""Of answers without a request's body."""


def find_avatar(request: HTTPConnection, identifier: str) -> Avatar:
    """The avatar of that id; raises Problem 404 naming those there are."""
    avatars: dict[str, Avatar] = request.app.state.library.avatars
    if identifier not in avatars:
        raise Problem(404, f"there is no avatar {identifier[:64]!r}; there is {', '.join(avatars) or 'none'}")
    return avatars[identifier]


def require_known(request: Request, *names: str) -> None:
    """Raise Problem for a parameter that is none: ``?garments=`` would be answered as if nothing had been asked."""
    for name in request.query_params:
        if name not in names:
            there = f"there is {', '.join(names)}" if names else "there are none"
            raise Problem(422, f"{name[:40]!r} is no parameter here; {there}")


def add_avatars(app: FastAPI) -> None:
    """Mount the routes."""

    @app.get("/avatars")
    async def avatars() -> list[dict[str, Any]]:
        """What there is to dress."""
        return [avatar.summary() for avatar in app.state.library.avatars.values()]

    @app.get("/avatars/{avatar}", responses=NOT_FOUND)
    async def describe(request: Request, avatar: AvatarId) -> dict[str, Any]:
        """One avatar: garments, joints, licence, provenance, metrics."""
        found = find_avatar(request, avatar)
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
        responses={200: {"content": {"application/json": {}, mesh.GLB_MEDIA_TYPE: {}}}, **NOT_FOUND, **LIMITS},
        response_class=Response,
    )
    async def static_mesh(
        request: Request,
        hold: Entered,
        avatar: AvatarId,
        format: Literal["json", "glb"] = "json",
        morph: Annotated[bool, Query(description="the GLB has the garments' blend shapes as morph targets")] = False,
    ) -> Response:
        """Body and garments in T-pose: vertices, faces and regions as JSON, or a GLB with a skin."""
        settings: Settings = request.app.state.settings
        require_known(request, "format", "morph")
        found = find_avatar(request, avatar)

        def work() -> Response:
            if format == "glb":
                content = found.once("morph", mesh.morph_glb) if morph else found.once("glb", mesh.mesh_glb)
            else:
                content = found.once("json", _mesh_json)
            hold.reserve(len(content))
            media_type = mesh.GLB_MEDIA_TYPE if format == "glb" else "application/json"
            return PartsResponse([content], media_type, settings.send_seconds)

        return await hold.run(work)


def _mesh_json(bundle: AvatarBundle) -> bytes:
    return json.dumps(mesh.mesh_json(bundle), separators=(",", ":")).encode()
