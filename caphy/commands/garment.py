"""``caphy garment``: make garment templates, check and take over your own meshes, picture them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from caphy.commands.body import load_body
from caphy.commands.output import OUTPUT
from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.io.places import writable_file

if TYPE_CHECKING:
    from caphy.garment.landmarks import Landmarks
    from caphy.garment.usermesh import UserMesh

Output = Annotated[Path, OUTPUT]
Positional = tyro.conf.Positional

Betas = tuple[float, ...]


@dataclass(frozen=True)
class MeshOptions:
    """How to read a mesh file."""

    scale: float = 1.0
    """Metres per unit of the file: 0.1 for decimetres (MakeHuman), 0.01 for centimetres."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """The file's up axis; y unless given. With y or x up the front looks along +z, with z up along -y (Blender)."""
    triangulate: bool = False
    """Split quads and larger polygons into triangles."""
    component: str | None = None
    """Take one piece of several: upper, lower, or its number (0 has most faces)."""
    rewind: bool = False
    """Turn over faces that are wound against their neighbours."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Move the mesh [m], after scaling; the body's hips are at the origin."""
    panel_scale: float = 1.0
    """Metres per unit of the panel (UV) coordinates, relative to --scale."""


def main(arguments: list[str]) -> int | None:
    """Entry point of ``caphy garment``."""
    prog, commands = (
        "caphy garment",
        {
            "make": _make_help,
            "info": info,
            "check": check,
            "from-mesh": from_mesh,
            "render": render,
        },
    )
    if arguments[:1] == ["make"]:
        from caphy.garment.families import FAMILIES

        prog, commands = "caphy garment make", {name: _maker(kind) for name, kind in FAMILIES.items()}
        arguments = arguments[1:]
    return tyro.extras.subcommand_cli_from_dict(
        commands, prog=prog, args=arguments, config=(tyro.conf.OmitArgPrefixes,)
    )


def _make_help() -> None:
    """Make a garment template on a body: caphy garment make {tshirt,longsleeve,tank,trousers,shorts,skirt}."""


def _maker(kind: type) -> Callable[..., None]:
    """The command that makes one family: its options are the family's own fields."""

    def run(options: Any, output: Path, body: str = "medium", betas: Betas = ()) -> None:
        from caphy.garment.families import make

        writable_file(output, ".npz", [body])
        garment = make(options, load_body(body), np.array(betas) if betas else None)
        garment.save(output)
        print(f"{output}: {len(garment.vertices)} vertices, {len(garment.faces)} faces")

    run.__doc__ = kind.__doc__
    run.__annotations__ = {
        "options": kind,
        "output": Annotated[Output, tyro.conf.arg(help="the garment npz to write")],
        "body": Annotated[str, tyro.conf.arg(help='an SMPL-X-format npz, or "medium" or "fine" for the bundled body')],
        "betas": Annotated[Betas, tyro.conf.arg(help="shape coefficients of the body")],
        "return": None,
    }
    return run


def info(file: Positional[Path]) -> None:
    """Print what a garment npz holds.

    Args:
        file: a garment npz, as 'caphy garment make' and 'from-mesh' write it.
    """
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
        "layer thickness": "{:.1f} to {:.1f} mm".format(*1000 * np.quantile(garment.layer_thickness, [0, 1])),
        "attached": f"{int((garment.attached > 0).sum())} vertices",
        **garment.provenance,
    }
    width = max(map(len, rows))
    print("\n".join(f"{key.ljust(width)}  {value}" for key, value in rows.items()))


def check(
    file: Positional[Path], options: MeshOptions = MeshOptions(), body: str = "medium", betas: Betas = ()
) -> None:
    """Say whether a mesh file (OBJ, PLY, GLB) can be a garment, and what to do if not; writes nothing.

    Args:
        file: the mesh, which lies on the body in T-pose.
        body: an SMPL-X-format npz, or "medium" or "fine" for the bundled body.
        betas: shape coefficients of the body.
    """
    mesh, marks = _read(file, options, body, betas)
    from caphy.garment.from_mesh import garment_from_mesh

    garment = garment_from_mesh(mesh, file.stem, marks, panel_scale=options.panel_scale)
    print(f"{file}: can be made a garment")
    _describe(mesh, marks, garment)


def from_mesh(
    file: Positional[Path],
    output: Output,
    options: MeshOptions = MeshOptions(),
    name: str | None = None,
    waistband: bool = False,
    layer_thickness: float = 0.0,
    body: str = "medium",
    betas: Betas = (),
) -> None:
    """Turn a mesh file (OBJ, PLY, GLB) that lies on the body in T-pose into a garment npz.

    Args:
        file: the mesh.
        output: the garment npz to write.
        name: name of the garment, of lower-case letters, digits, - and _; the file's by default.
        waistband: hold the highest opening to the body, as trousers and skirts need.
        layer_thickness: extra distance to keep from the body [m], for what is worn over something else.
        body: an SMPL-X-format npz, or "medium" or "fine" for the bundled body.
        betas: shape coefficients of the body.
    """
    from caphy.garment.from_mesh import garment_from_mesh
    from caphy.io.bundle import require_garment_name

    writable_file(output, ".npz", [file, body])
    name = name or file.stem
    require_garment_name(name, str(file), "give one with --name")
    mesh, marks = _read(file, options, body, betas)
    garment = garment_from_mesh(
        mesh,
        name,
        marks,
        panel_scale=options.panel_scale,
        waistband=waistband,
        layer_thickness=layer_thickness,
        provenance={"file": file.name, **{key: str(value) for key, value in asdict(options).items()}},
    )
    garment.save(output)
    print(f"{output}: {garment.name}")
    _describe(mesh, marks, garment)


def render(garments: Positional[tuple[Path, ...]], output: Output, body: str = "fine", betas: Betas = ()) -> None:
    """Picture garments on the body: front, three-quarter, side and back.

    Args:
        garments: garment npz files, worn together.
        output: the PNG to write.
        body: an SMPL-X-format npz, or "medium" or "fine" for the bundled body.
        betas: shape coefficients of the body.
    """
    from caphy.report.camera import Camera
    from caphy.report.render import CLOTH, Shape, contact_sheet, write_png
    from caphy.report.render import render as draw

    if not garments:
        raise CaphyError("render needs at least one garment npz")
    writable_file(output, ".png")
    wearer = load_body(body)
    shapes = [Shape(wearer.rest(np.array(betas) if betas else None)[0], wearer.faces)]
    for i, path in enumerate(garments):
        garment = Garment.load(path)
        shapes.append(Shape(garment.vertices, garment.faces, CLOTH[i % len(CLOTH)]))
    points = np.concatenate([shape.vertices for shape in shapes[1:]])
    views = [draw(shapes, Camera.framing(points, azimuth=a, elevation=8.0)) for a in (0.0, 45.0, 90.0, 180.0)]
    print(write_png(contact_sheet(views, 4), output))


def _read(file: Path, options: MeshOptions, body: str, betas: Betas) -> tuple[UserMesh, Landmarks]:
    """The mesh on its body."""
    from caphy.garment.landmarks import Landmarks
    from caphy.garment.usermesh import clean_mesh, read_mesh

    if not 0 < options.scale < np.inf:
        raise CaphyError(f"--scale must be positive and finite [m per unit of the file], got {options.scale:g}")
    if not 0 < options.panel_scale < np.inf:
        raise CaphyError(f"--panel-scale must be positive and finite, got {options.panel_scale:g}")
    if not np.isfinite(options.offset).all():
        raise CaphyError(f"--offset must be three finite numbers, got {options.offset}")
    mesh = clean_mesh(
        read_mesh(file),
        scale=options.scale,
        up=options.up,
        triangulate=options.triangulate,
        component=options.component,
        rewind=options.rewind,
    )
    marks = Landmarks.of(load_body(body), np.array(betas) if betas else None)
    return replace(mesh, vertices=mesh.vertices + np.array(options.offset)), marks


def _describe(mesh: UserMesh, marks: Landmarks, garment: Garment) -> None:
    from caphy.garment import topology
    from caphy.garment.from_mesh import clearance

    distance = clearance(mesh, marks)
    angles = np.degrees(topology.face_angles(mesh.vertices, mesh.faces).min(axis=1))
    print(
        f"  {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, {len(topology.boundary_loops(mesh.faces))} openings"
    )
    print(f"  smallest angle under 20 degrees in {100 * (angles < 20).mean():.1f} % of the faces")
    print(f"  rest metric: {garment.provenance['metric']}")
    names, counts = np.unique(garment.regions, return_counts=True)
    most = sorted(zip(counts.tolist(), names.tolist(), strict=True), reverse=True)[:4]
    shares = ", ".join(f"{name} {100 * count / len(mesh.vertices):.0f} %" for count, name in most)
    print(f"  moves with {shares}; elsewhere on the body? Move it with --offset, or turn it with --up")
    print(
        f"  {100 * (distance < 0).mean():.1f} % of the vertices lie inside the body; "
        f"the lowest clearance is {1000 * distance.min():.1f} mm"
    )
    if not topology.boundary_loops(mesh.faces):
        print("  it has no openings, so that nobody could put it on")
    if (distance < 0).mean() > 0.02:
        print("  the garment must lie outside the body in T-pose: move it with --offset, or fit it in a mesh editor")
