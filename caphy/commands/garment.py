"""``caphy garment``: make garment templates, check and take over your own meshes, picture them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from caphy.body.bundled import default_body
from caphy.body.model import BodyModel
from caphy.garment.template import Garment

Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Betas = tuple[float, ...]


def main(arguments: list[str]) -> int | None:
    """Entry point of ``caphy garment``."""
    if arguments[:1] == ["make"]:
        from caphy.garment.families import FAMILIES

        commands = {name: _maker(kind) for name, kind in FAMILIES.items()}
        return tyro.extras.subcommand_cli_from_dict(
            commands,
            prog="caphy garment make",
            description="Make a garment template on a body in T-pose. Lengths in metres.",
            args=arguments[1:],
            config=(tyro.conf.OmitArgPrefixes,),
        )
    commands: dict[str, Callable[..., Any]] = {
        "make": _make_help,
        "info": info,
    }
    return tyro.extras.subcommand_cli_from_dict(commands, prog="caphy garment", args=arguments)


def _make_help() -> None:
    """Make a garment template on a body: caphy garment make {tshirt,longsleeve,tank,trousers,shorts,skirt}."""


def _maker(kind: type) -> Callable[..., None]:
    """The command that makes one family: its options are the family's own fields."""

    def run(options: Any, output: Path, body: Path | None = None, betas: Betas = ()) -> None:
        from caphy.garment.families import make

        garment = make(options, _body(body), np.array(betas) if betas else None)
        garment.save(output)
        print(f"{output}: {len(garment.vertices)} vertices, {len(garment.faces)} faces")

    run.__doc__ = kind.__doc__
    run.__annotations__ = {
        "options": kind,
        "output": Annotated[Path, tyro.conf.arg(aliases=["-o"], help="the garment npz to write")],
        "body": Annotated[Path | None, tyro.conf.arg(help="SMPL-X-format npz; default: the bundled body")],
        "betas": Annotated[Betas, tyro.conf.arg(help="shape coefficients of the body")],
        "return": None,
    }
    return run


def _body(path: Path | None) -> BodyModel:
    return default_body("medium") if path is None else BodyModel.load(path)


def info(file: tyro.conf.Positional[Path]) -> None:
    """Print what a garment npz holds."""
    garment = Garment.load(file)
    edge = np.linalg.norm(np.diff(garment.material[:, :2], axis=1), axis=2)
    names, counts = np.unique(garment.regions, return_counts=True)
    rows = {
        "name": garment.name,
        "vertices, faces": f"{len(garment.vertices)}, {len(garment.faces)}",
        "area": f"{garment.rest_areas.sum():.3f} m2",
        "edge length": f"{1000 * np.median(edge):.1f} mm (median, rest metric)",
        "openings": ", ".join(f"{len(loop)} vertices" for loop in garment.boundary_loops),
        "regions": ", ".join(f"{n} {c}" for n, c in zip(names, counts, strict=True)),
        "layer thickness": f"{1000 * garment.layer_thickness.min():.1f} to {1000 * garment.layer_thickness.max():.1f} mm",
        "attached": f"{int((garment.attached > 0).sum())} vertices",
        **garment.provenance,
    }
    width = max(map(len, rows))
    print("\n".join(f"{key.ljust(width)}  {value}" for key, value in rows.items()))
