"""A user's own mesh (OBJ, PLY, GLB): read, checked, and turned into one clean component in metres, y up."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from caphy.errors import CaphyError
from caphy.garment import topology
from caphy.garment.polygons import Corners, triangles

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
SUFFIXES = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
UNITS = {1.0: "metres", 0.1: "decimetres", 0.01: "centimetres", 0.001: "millimetres", 0.0254: "inches"}
PLAUSIBLE = (0.25, 2.2)
"""Longest side [m] that a garment may have."""
_NAMED = 6  # pieces of a mesh that are named at most
_TAKE = "pass --component upper, --component lower or --component N to take one"


@dataclass(frozen=True)
class RawMesh:
    """A polygon mesh as the file has it."""

    path: Path
    vertices: np.ndarray
    """(V, 3), the file's own unit and axes."""
    polygons: list[list[int]]
    """Corner vertices of each polygon."""
    uv: np.ndarray
    """Texture or panel coordinates (N, 2), empty if there are none."""
    uv_polygons: list[list[int]] | None
    """Corner coordinates of each polygon, or None."""


@dataclass(frozen=True)
class UserMesh:
    """One manifold triangle component in metres, y up, facing +z."""

    vertices: np.ndarray
    """(V, 3) [m]."""
    faces: np.ndarray
    """(F, 3) int32."""
    panel: np.ndarray | None
    """Flat coordinates (F, 3, 2) of each face's corners in the file's unit times the scale, or None."""


def read_mesh(path: str | Path) -> RawMesh:
    """Read a polygon mesh. OBJ keeps polygons and panel coordinates; other formats come through trimesh.

    Raises
        CaphyError: if the file is missing, of another kind, damaged, empty or not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise CaphyError(f"{path}: there is no such file")
    if path.suffix.lower() not in SUFFIXES:
        raise CaphyError(f"{path}: must be one of {', '.join(SUFFIXES)}, got {path.suffix or 'no suffix'!r}")
    raw = _read_obj(path) if path.suffix.lower() == ".obj" else _read_with_trimesh(path)
    if not raw.polygons:
        raise CaphyError(f"{path}: must contain faces, got none; export the mesh with faces, not as points or lines")
    bad = ~np.isfinite(raw.vertices).all(axis=1)
    if bad.any():
        raise CaphyError(f"{path}: coordinates must be finite, vertex {np.flatnonzero(bad)[0]} is not")
    return raw


def _read_obj(path: Path) -> RawMesh:
    vertices: list[list[float]] = []
    uv: list[list[float]] = []
    polygons, uv_polygons = [], []
    for number, line in _whole_lines(path.read_text(errors="replace").splitlines()):
        word, *rest = line.split("#")[0].split() or [""]
        try:
            if word == "v":
                vertices.append([float(x) for x in rest[:3]])
            elif word == "vt":
                uv.append([float(x) for x in rest[:2]])
            elif word == "f":
                corners = [c.split("/") for c in rest]
                if len(corners) < 3:
                    raise ValueError("a face needs three corners")
                polygons.append([_index(c[0], len(vertices)) for c in corners])
                uv_polygons.append([_index(c[1], len(uv)) for c in corners if len(c) > 1 and c[1]])
        except (ValueError, IndexError) as error:
            raise CaphyError(
                f"{path}, line {number}: cannot be read as OBJ ({error}): {line.strip()[:60]!r}"
            ) from error
    if any(len(v) != 3 for v in vertices):
        raise CaphyError(f"{path}: every vertex must have three coordinates")
    complete = bool(uv) and all(len(a) == len(b) for a, b in zip(polygons, uv_polygons, strict=True))
    for name, groups, count in (("vertex", polygons, len(vertices)), ("vt", uv_polygons, len(uv))):
        worst = max((i for g in groups for i in g), default=-1)
        if worst >= count or min((i for g in groups for i in g), default=0) < 0:
            wrong = f"{name} {worst + 1}" if worst >= count else f"one before the first {name}"
            raise CaphyError(f"{path}: a face refers to {wrong}, but there are {count}, counted from 1")
    points = np.array(vertices, float).reshape(-1, 3)
    return RawMesh(path, points, polygons, np.array(uv, float).reshape(-1, 2), uv_polygons if complete else None)


def _whole_lines(lines: Sequence[str]) -> Iterator[tuple[int, str]]:
    """Lines with those that continue them (after a backslash), and the number of the first of each, counted from 1."""
    begun, first = "", 1
    for number, line in enumerate(lines, 1):
        first = first if begun else number
        if line.endswith("\\"):
            begun += line[:-1] + " "
            continue
        yield first, begun + line
        begun = ""
    if begun:
        yield first, begun


def _index(word: str, count: int) -> int:
    """OBJ indices start at one; negative ones count back from the latest."""
    value = int(word)
    return value - 1 if value >= 0 else count + value


def _read_with_trimesh(path: Path) -> RawMesh:
    import trimesh

    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:
        raise CaphyError(f"{path}: cannot be read as {path.suffix[1:].upper()} ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise CaphyError(f"{path}: must contain a mesh of faces")
    found = getattr(mesh.visual, "uv", None)
    # formats with one coordinate per vertex split vertices along seams: join them again by position
    vertices, same = np.unique(np.asarray(mesh.vertices), axis=0, return_inverse=True)
    faces = same.reshape(-1)[np.asarray(mesh.faces)]
    uv = np.zeros((0, 2)) if found is None else np.asarray(found, float)[:, :2]
    return RawMesh(path, vertices, faces.tolist(), uv, None if found is None else np.asarray(mesh.faces).tolist())


def clean_mesh(
    raw: RawMesh,
    *,
    scale: float = 1.0,
    up: Axis | None = None,
    triangulate: bool = False,
    component: str | None = None,
    rewind: bool = False,
) -> UserMesh:
    """One component of ``raw`` as manifold triangles in metres, y up.

    ``component`` is ``upper`` or ``lower`` (by mean height) or a number (0 has most faces); ``up`` None means y, but
    not if the mesh then lies flat. ``rewind`` turns over faces that are wound against their neighbours.

    Raises
        CaphyError: for polygons, several components, a wrong unit or up axis, or a mesh that is not an oriented
            manifold; each message says which option or repair helps.
    """
    polygons, panels = raw.polygons, raw.uv_polygons
    corners = np.array([len(p) for p in polygons])
    if corners.max() > 3 and not triangulate:
        raise CaphyError(
            f"{raw.path}: faces must be triangles, got {int((corners > 3).sum())} of {len(corners)} with more corners "
            f"(first: face {int(np.argmax(corners > 3))}); pass --triangulate to split them"
        )
    cut = triangles(raw.vertices, polygons)
    uncut = [i for i, each in enumerate(cut) if not each]
    for i in uncut:  # to see which piece it is of
        cut[i] = [(0, k, k + 1) for k in range(1, len(polygons[i]) - 1)]
    faces = _cornered(polygons, cut)
    panel = None if panels is None else raw.uv[_cornered(panels, cut)] * scale
    vertices = upright(raw.vertices, up or "y") * scale
    chosen = _choose(raw, vertices, faces, component)
    worn = set(np.repeat(np.arange(len(polygons)), [len(each) for each in cut])[chosen].tolist())
    if uncut := [i for i in uncut if i in worn]:
        raise CaphyError(
            f"{raw.path}: face {uncut[0]} with {len(polygons[uncut[0]])} corners cannot be cut into triangles "
            f"({len(uncut)} such faces); it has no area or crosses itself: triangulate it in a mesh editor"
        )
    used, flat = np.unique(faces[chosen], return_inverse=True)
    vertices, faces = vertices[used], flat.reshape(-1, 3).astype(np.int32)
    _check_size(raw, vertices, scale)
    if up is None:
        _check_upright(raw, vertices)
    panel = None if panel is None else panel[chosen]
    if rewind:
        order = topology.consistent_winding(faces)
        faces = np.where(order[:, None], faces[:, ::-1], faces)
        panel = None if panel is None else np.where(order[:, None, None], panel[:, ::-1], panel)
    _check_defects(raw, topology.check_manifold(faces))
    return UserMesh(vertices, faces, panel)


def _check_defects(raw: RawMesh, defects: topology.Defects) -> None:
    if not defects:
        return
    only_winding = not (defects.edges.size or defects.vertices.size or defects.degenerate.size)
    repair = (
        "pass --rewind to wind all faces alike"
        if only_winding
        else (
            "repair it in a mesh editor (in Blender: Mesh > Clean Up > Merge by Distance, then delete doubled or "
            "inner faces)"
        )
    )
    raise CaphyError(
        f"{raw.path}: the mesh must be an oriented manifold with open hems, got {defects.describe()}; {repair}"
    )


def _cornered(polygons: list[list[int]], cut: list[list[Corners]]) -> np.ndarray:
    """Triangles (F, 3) of polygons, cut at the places of their corners."""
    found = [[p[i] for i in each] for p, own in zip(polygons, cut, strict=True) for each in own]
    return np.array(found, dtype=np.int64)


def upright(points: np.ndarray, up: Axis) -> np.ndarray:
    """Points (N, 3) turned so that the file's ``up`` axis is +y.

    z up is taken to face -y and x up to face +z, the customs of their tools.
    """
    turn = {
        "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "-y": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
        "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        "-z": [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],
        "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
        "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    }
    return points @ np.array(turn[up], float).T


def _choose(raw: RawMesh, vertices: np.ndarray, faces: np.ndarray, component: str | None) -> np.ndarray:
    """Faces of the wanted component."""
    parts = topology.components(faces)
    height = [float(vertices[faces[p]][..., 1].mean()) for p in parts]
    if component is None:
        if len(parts) > 1:
            largest = [
                f"{i}: {len(p)} faces at height {h:.2f}" for i, (p, h) in enumerate(zip(parts, height, strict=True))
            ][:_NAMED]
            rest = f" and {len(parts) - _NAMED} more" if len(parts) > _NAMED else ""
            apart = len(parts) == len(faces)
            raise CaphyError(
                f"{raw.path}: must be one connected piece, got {len(parts)} ({', '.join(largest)}{rest}); "
                + ("join its vertices in a mesh editor (merge by distance)" if apart else _TAKE)
            )
        return parts[0]
    large = [i for i, p in enumerate(parts) if len(p) >= 0.2 * len(parts[0])]  # not a button or a belt loop
    if component in ("upper", "lower"):
        if len(parts) == 1:
            raise CaphyError(
                f"{raw.path}: is one connected piece, so that none is {component}; cut it in a mesh editor, or leave "
                "--component out"
            )
        pick = (max if component == "upper" else min)(large, key=lambda i: height[i])
        return parts[pick]
    if not component.isdecimal() or int(component) >= len(parts):
        raise CaphyError(f"{raw.path}: component must be upper, lower or 0 to {len(parts) - 1}, got {component!r}")
    return parts[int(component)]


def _check_size(raw: RawMesh, vertices: np.ndarray, scale: float) -> None:
    extent = np.ptp(vertices, axis=0)
    longest = float(extent.max())
    if PLAUSIBLE[0] <= longest <= PLAUSIBLE[1]:
        return
    fits = [
        f"--scale {s * scale:g} ({name})" for s, name in UNITS.items() if PLAUSIBLE[0] <= longest * s <= PLAUSIBLE[1]
    ]
    hint = " or ".join(fits) or "--scale with metres per unit of the file"
    raise CaphyError(
        f"{raw.path}: a garment must measure {PLAUSIBLE[0]} to {PLAUSIBLE[1]} m along its longest side, got "
        f"{longest:.3g} m (at --scale {scale:g}); the file's unit is not metres: pass {hint}"
    )


def _check_upright(raw: RawMesh, vertices: np.ndarray) -> None:
    width, height, depth = np.ptp(vertices, axis=0)
    if height < 0.6 * min(width, depth):
        raise CaphyError(
            f"{raw.path}: the y axis must point up, but the mesh is only {height:.2f} m high, {width:.2f} m wide and "
            f"{depth:.2f} m deep, as if it lay down; pass --up z (Blender, 3-D scanners), or --up y if it is meant so"
        )
