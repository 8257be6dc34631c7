"""Scan meshes as files: PLY, OBJ, GLB with vertex colours or a texture, in the file's own vertex order."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io.places import write_bytes
from caphy.scan.glb_bytes import ordered_glb
from caphy.scan.obj_lines import read_obj_lines

SUFFIXES: Final = (".ply", ".obj", ".glb")
_RGB = ("red", "green", "blue")


@dataclass(frozen=True, eq=False)
class MeshFile:
    """What a file holds, in its own units and axes.

    vertices (V, 3) float64, faces (F, 3) int32, colours (V, 3) uint8 or none, label (V,) integers or none (a vertex
    property ``label`` of a PLY).
    """

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray | None
    label: np.ndarray | None


def read_mesh_file(path: Path) -> MeshFile:
    """The mesh in a file.

    Raises:
        CaphyError: it is missing, damaged, of an unknown kind, or holds no triangles.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise CaphyError(f"{path}: scans end in {', '.join(SUFFIXES)}; got {path.suffix or 'no suffix'}")
    if not path.is_file():
        raise CaphyError(f"{path}: there is no such file")
    try:
        found = _READERS[path.suffix.lower()](path)
    except CaphyError:
        raise
    except Exception as error:  # readers of damaged files can fail anywhere
        raise CaphyError(f"{path}: cannot be read as a mesh: {type(error).__name__}: {error}") from error
    if not len(found.faces):
        raise CaphyError(
            f"{path}: a scan must be a triangle mesh, this is a cloud of {len(found.vertices)} points; mesh it"
        )
    return found


def write_ply(path: Path, mesh: MeshFile) -> None:
    """Write a binary PLY (float32 positions), whole or not at all."""
    import trimesh

    made: Any = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if mesh.colours is not None:
        made.visual.vertex_colors = mesh.colours
    if mesh.label is not None:
        made.vertex_attributes["label"] = mesh.label.astype(np.uint8)
    write_bytes(path, made.export(file_type="ply"))


def _read_ply(path: Path) -> MeshFile:
    pictured = _has_texture(path)
    mesh = _loaded(path, skip_materials=not pictured)
    vertices, faces, colours = _parts(mesh, path)
    raw = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    raw = {} if raw is None else raw
    names = raw if isinstance(raw, dict) else raw.dtype.names  # a dict in ASCII
    told = {name: np.asarray(raw[name]).reshape(-1) for name in names}
    if told.keys() >= set("xyz") and len(told["x"]) != len(vertices):  # split along the seams of a texture
        wanted = np.stack([told[axis] for axis in "xyz"], axis=1).astype(np.float64)
        vertices, faces, colours = _in_order(wanted, vertices, faces, colours)
    textured = mesh.visual is not None and mesh.visual.kind == "texture"
    if textured and not pictured:
        colours = None  # a grey of the reader's own
    short = not textured and told.keys() >= set(_RGB) and told["red"].dtype == np.uint16
    if told.keys() >= set(_RGB) and (colours is None or short):
        own = np.stack([told[name] for name in _RGB], axis=1)
        colours = (own >> 8 if own.dtype == np.uint16 else own if own.max() > 1 else 255 * own).astype(np.uint8)
    return MeshFile(vertices, faces, colours, told["label"].astype(np.int64) if "label" in told else None)


def _has_texture(path: Path) -> bool:
    """Whether a PLY names a picture that lies beside it."""
    with path.open("rb") as file:
        for line in file:
            text = line.decode("utf-8", errors="replace").strip()
            place = text.lower().find("texturefile")
            if place >= 0:
                return (path.parent / text[place + 11 :].strip()).is_file()
            if text == "end_header":
                break
    return False


def _read_obj(path: Path) -> MeshFile:
    """Vertices in the order of the ``v`` lines, which labels refer to; a texture comes before their own colours."""
    from trimesh.resolvers import FilePathResolver

    lines = read_obj_lines(path)
    colours = None
    if lines.painted:  # a reader without the material makes a grey of its own
        text = io.BytesIO(lines.plain.encode())
        mesh = _loaded(text, file_type="obj", resolver=FilePathResolver(str(path)))
        colours = _in_order(lines.vertices, *_parts(mesh, path))[2]
    vertices, faces, _ = _in_order(lines.vertices, lines.vertices, lines.faces, None)
    return MeshFile(vertices, faces, lines.colours if colours is None else colours, None)


def _read_glb(path: Path) -> MeshFile:
    mesh = _loaded(io.BytesIO(ordered_glb(path.read_bytes())), file_type="glb")
    vertices, faces, colours = _parts(mesh, path)
    first = np.sort(np.unique(vertices, axis=0, return_index=True)[1])  # the file's order, which labels refer to
    return MeshFile(*_in_order(vertices[first], vertices, faces, colours), None)


_READERS: Final = {".ply": _read_ply, ".obj": _read_obj, ".glb": _read_glb}


def _loaded(source: Path | io.BytesIO, **how: Any) -> Any:
    import trimesh

    loaded: Any = trimesh.load(source, process=False, maintain_order=True, **how)
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_mesh()
    if not hasattr(loaded, "faces"):
        loaded = trimesh.Trimesh(loaded.vertices, np.zeros((0, 3), np.int64), process=False)
    return loaded


def _parts(mesh: Any, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
    return vertices, np.array(mesh.faces, dtype=np.int32).reshape(-1, 3), _colours(mesh, path)


def _colours(mesh: Any, path: Path) -> np.ndarray | None:
    """Colours (V, 3) of the vertices, looked up in the texture where there is one.

    Raises:
        CaphyError: the texture is damaged.
    """
    visual: Any = mesh.visual
    if visual is None or not visual.defined:
        return None
    if visual.kind == "texture":
        if visual.uv is None or (getattr(visual.material, "image", None) is None and not _has_base_image(visual)):
            return None
        try:
            visual = visual.to_color()
        except Exception as error:  # pictures are read only here
            raise CaphyError(
                f"{path}: its texture cannot be read ({type(error).__name__}: {error}); copy the picture again"
            ) from error
    colours = np.asarray(visual.vertex_colors)
    return colours[:, :3].astype(np.uint8) if colours.shape == (len(mesh.vertices), 4) else None


def _has_base_image(visual: Any) -> bool:
    return getattr(visual.material, "baseColorTexture", None) is not None


def _in_order(
    wanted: np.ndarray, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The mesh on vertices (W, 3), which a reader may have split along seams of the texture or put in another order."""
    both, place = np.unique(np.concatenate([wanted, vertices]), axis=0, return_inverse=True)
    place = place.reshape(-1)
    first = np.full(len(both), -1)
    first[place[: len(wanted)][::-1]] = np.arange(len(wanted))[::-1]
    to = first[place[len(wanted) :]]
    if (to < 0).any():
        return vertices, faces, colours
    faces = to[faces].astype(np.int32)
    moved = None
    if colours is not None:
        moved = np.zeros((len(wanted), 3), dtype=np.uint8)
        moved[to] = colours
        moved = moved[first[place[: len(wanted)]]]  # a place that the file lists twice has one colour
    return wanted, faces, moved
