"""Scan meshes as files: PLY, OBJ, GLB with vertex colours or a texture, in the file's own vertex order."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io.places import write_bytes

SUFFIXES: Final = (".ply", ".obj", ".glb")


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
    mesh = _load(path)
    vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces, dtype=np.int32).reshape(-1, 3)
    if not len(faces):
        raise CaphyError(f"{path}: a scan must be a triangle mesh, this is a cloud of {len(vertices)} points; mesh it")
    colours, label = _colours(mesh, path), _ply_label(mesh)
    if path.suffix.lower() == ".obj":
        wanted, painted = _obj_vertices(path)
        # A reader without the material makes a grey of its own
        vertices, faces, colours = _in_order(wanted, vertices, faces, colours if painted else None)
    elif path.suffix.lower() == ".glb":
        first = np.sort(np.unique(vertices, axis=0, return_index=True)[1])  # the file's order, which labels refer to
        vertices, faces, colours = _in_order(vertices[first], vertices, faces, colours)
    return MeshFile(vertices, faces, colours, label)


def write_ply(path: Path, mesh: MeshFile) -> None:
    """Write a binary PLY (float32 positions), whole or not at all."""
    import trimesh

    made: Any = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if mesh.colours is not None:
        made.visual.vertex_colors = mesh.colours
    if mesh.label is not None:
        made.vertex_attributes["label"] = mesh.label.astype(np.uint8)
    write_bytes(path, made.export(file_type="ply"))


def _load(path: Path) -> Any:
    import trimesh

    try:
        loaded: Any = trimesh.load(path, process=False, maintain_order=True)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_mesh()
        if not hasattr(loaded, "faces"):
            loaded = trimesh.Trimesh(loaded.vertices, np.zeros((0, 3), np.int64), process=False)
    except Exception as error:  # readers of damaged files can fail anywhere
        raise CaphyError(f"{path}: cannot be read as a mesh: {type(error).__name__}: {error}") from error
    return loaded


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


def _ply_label(mesh: Any) -> np.ndarray | None:
    data = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = data if isinstance(data, dict) else getattr(getattr(data, "dtype", None), "names", None)  # a dict in ASCII
    if data is None or not names or "label" not in names:
        return None
    return np.asarray(data["label"]).reshape(-1).astype(np.int64)


def _obj_vertices(path: Path) -> tuple[np.ndarray, bool]:
    """Positions (V, 3) in the order of the file's ``v`` lines, which labels refer to, and whether colours are there.

    They are missing where the file names a material (``mtllib``) that does not lie beside it, unless its vertices have
    colours of their own.
    """
    lines = [line.split(maxsplit=7) for line in path.read_text(encoding="utf-8", errors="replace").splitlines()]
    vertices = [line for line in lines if line[:1] == ["v"]]
    # A line names one file, whose name may have spaces, or several
    materials = [(" ".join(line[1:]), *line[1:]) for line in lines if line[:1] == ["mtllib"]]
    there = all(any((path.parent / name).is_file() for name in names) for names in materials)
    painted = there or any(len(line) > 6 for line in vertices[:1])
    return np.array([line[1:4] for line in vertices], dtype=np.float64).reshape(-1, 3), painted


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
    return wanted, faces, moved
