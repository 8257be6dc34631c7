"""From an implicit surface to a clean triangle mesh: contour, cut along smooth curves, remesh, mirror."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from caphy.errors import TooSharp
from caphy.garment import topology

Field = Callable[[np.ndarray], np.ndarray]
"""A scalar field: points (N, 3) [m] to values (N,) [m]."""
SHORTEST = 0.25
"""Shortest edge of a cut sheet as a share of the edge length asked for; remeshing leaves most above a half."""
LEAST_AREA = 0.01
"""Least area of a cut sheet's faces as a share of their median."""


def contour(field: Field, low: np.ndarray, high: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Zero surface of a ``field`` symmetric in x, by marching cubes on a grid of ``step`` [m], lightly blurred.

    A narrow gap in the middle, as between thighs, is not blurred shut.
    ``low`` and ``high`` (3,) [m] bound the half x >= 0; the other half is its mirror image. Faces are wound so that
    the normal points to where the field is positive.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    axes = [np.arange(a, b + step, step) for a, b in zip((0.0, *low[1:]), high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    half = field(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    values = gaussian_filter(np.concatenate([half[:0:-1], half]), 1.0, mode="nearest")
    middle = values[len(half) - 1]
    gap = (half[0] > 0) & (half[1] < half[0] - 0.5 * step) & (half[1] < 0)  # between walls that face each other
    middle[gap] = np.maximum(middle, half[0])[gap]
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(step,) * 3, gradient_direction="descent")
    origin = np.array([-axes[0][-1], low[1], low[2]])
    return vertices + origin, faces.astype(np.int64)


def insert_curve(vertices: np.ndarray, faces: np.ndarray, field: Field) -> tuple[np.ndarray, np.ndarray]:
    """Split triangles along the curve where ``field`` is zero; vertices close to it are moved onto it.

    Returns vertices and faces in which no edge crosses the curve.
    """
    vertices, value = _snap(vertices, faces, field)
    edge = _crossed(faces, value)
    share = value[edge[:, 0]] / (value[edge[:, 0]] - value[edge[:, 1]])
    points = vertices[edge[:, 0]] + share[:, None] * (vertices[edge[:, 1]] - vertices[edge[:, 0]])
    middle = {tuple(pair): len(vertices) + i for i, pair in enumerate(edge.tolist())}
    crossing = _both_sides(faces, value)
    pieces = []
    for face in faces[crossing].tolist():
        cut = [middle.get((min(a, b), max(a, b))) for a, b in zip(face, face[1:] + face[:1], strict=True)]
        pieces.extend(_split(face, cut))
    return np.concatenate([vertices, points]), np.concatenate(
        [faces[~crossing], np.array(pieces, faces.dtype).reshape(-1, 3)]
    )


def _both_sides(faces: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Which faces (F,) have corners on both sides of the curve where ``value`` (V,) is zero."""
    of_corners = value[faces]
    return (of_corners.min(axis=1) < 0) & (of_corners.max(axis=1) > 0)


def _crossed(faces: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Edges (E, 2) whose ends lie on different sides of the curve where ``value`` (V,) is zero."""
    edge = topology.edges(faces[_both_sides(faces, value)])
    return edge[value[edge[:, 0]] * value[edge[:, 1]] < 0]


def _snap(vertices: np.ndarray, faces: np.ndarray, field: Field, share: float = 0.25) -> tuple[np.ndarray, np.ndarray]:
    """Move each vertex that lies within ``share`` of an edge's length of the curve onto it, along that edge."""
    value = field(vertices)
    vertices = vertices.copy()
    edge = _crossed(faces, value)
    for a, b in np.concatenate([edge, edge[:, ::-1]]):
        if value[a] * value[b] < 0 and abs(value[a]) < share * abs(value[a] - value[b]):
            vertices[a] += value[a] / (value[a] - value[b]) * (vertices[b] - vertices[a])
            value[a] = 0.0
    return vertices, value


def _split(face: list[int], cut: list[int | None]) -> list[list[int]]:
    """Pieces of a triangle whose edges k -> k+1 are cut at ``cut[k]`` (one or two of them)."""
    polygon = [(v, False) for v in face]
    ring: list[tuple[int, bool]] = []
    for corner, new in zip(polygon, cut, strict=True):
        ring.append(corner)
        if new is not None:
            ring.append((new, True))
    if len(ring) == 4:  # one cut edge: join the cut to the opposite corner
        k = next(i for i, (_, new) in enumerate(ring) if new)
        r = [v for v, _ in ring[k:] + ring[:k]]
        return [[r[0], r[1], r[2]], [r[0], r[2], r[3]]]
    k = next(i for i in range(5) if ring[i][1] and ring[(i + 2) % 5][1])  # the lone corner is at k + 1
    r = [v for v, _ in ring[k:] + ring[:k]]
    return [[r[0], r[1], r[2]], [r[0], r[2], r[3]], [r[0], r[3], r[4]]]


def cut_sheet(
    vertices: np.ndarray, faces: np.ndarray, keep: Sequence[Field], edge_length: float
) -> tuple[np.ndarray, np.ndarray]:
    """The part of a surface where every field of ``keep`` is positive, remeshed to ``edge_length`` [m].

    Curves where a field vanishes become smooth boundaries with evenly spaced vertices: the surface is remeshed
    with the curves as crease lines (Botsch and Kobbelt 2004, in gpytoolbox), then what lies beyond is dropped.
    Where that tears a crease, as it may where cloth lies tight and edges are long, it is tried by way of edges half
    as long.

    Raises
        TooSharp: if the surface turns too sharply for edges of that length.
    """
    margin = 2.5 * edge_length
    for field in keep:
        faces = faces[(field(vertices)[faces] > -margin).any(axis=1)]
        vertices, faces = drop_unused(vertices, faces)
        vertices, faces = insert_curve(vertices, faces, field)
    openings = len(topology.boundary_loops(_kept(vertices, faces, keep)))
    for lengths in ((edge_length,), (0.5 * edge_length, edge_length)):
        sheet = _remeshed(vertices, faces, keep, lengths)
        if _clean(*sheet) and len(topology.boundary_loops(sheet[1])) == openings:  # no strap is torn
            return sheet
    raise too_sharp(edge_length)


def too_sharp(edge_length: float) -> TooSharp:
    """What is said of a cut that cannot be meshed with edges of a length [m]."""
    return TooSharp(
        f"the cut turns too sharply for edges of {1e3 * edge_length:.1f} mm: faces would fold over or have no area; "
        "ask for a shorter edge_length or for more ease"
    )


def _remeshed(
    vertices: np.ndarray, faces: np.ndarray, keep: Sequence[Field], lengths: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """The sheet, remeshed to each of ``lengths`` [m] in turn along the curves, which edges of the mesh follow."""
    from gpytoolbox import remesh_botsch

    for length in lengths:
        inside = np.stack([field(vertices[faces].mean(axis=1)) > 0 for field in keep], axis=1)
        sides = inside[topology.hinge_faces(faces)]
        crease = topology.hinges(faces)[(sides[:, 0] != sides[:, 1]).any(axis=1), :2]
        vertices, faces = remesh_botsch(vertices, faces, 12, length, True, feature_edges=crease)
    vertices, faces = drop_unused(vertices, _kept(vertices, faces, keep))
    vertices, faces = collapse_short(vertices, faces, SHORTEST * lengths[-1])
    return remesh_botsch(vertices, faces, 4, lengths[-1], True)  # settles the interior behind the new boundary


def _kept(vertices: np.ndarray, faces: np.ndarray, keep: Sequence[Field]) -> np.ndarray:
    """The faces (F, 3) where every field of ``keep`` is positive, of what hangs together there the largest piece."""
    faces = faces[np.all([field(vertices[faces].mean(axis=1)) > 0 for field in keep], axis=0)]
    return faces[topology.components(faces)[0]]


def _clean(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether the mesh is a manifold and each face has its share of area."""
    areas = topology.face_areas(vertices, faces)
    return not topology.check_manifold(faces, len(vertices)) and areas.min() > LEAST_AREA * np.median(areas)


def collapse_short(vertices: np.ndarray, faces: np.ndarray, shortest: float) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with edges below ``shortest`` [m] drawn together, each to its middle or to its end on the boundary.

    Remeshing keeps vertices where creases meet or the sheet ends as they are, however close they lie, and a triangle
    between two of them has hardly any area (or none), so no rest shape. An edge stays where its collapse would
    change the topology (link condition, Dey et al. 1999) or turn a neighbouring face over.
    """
    stuck: set[tuple[int, int]] = set()
    while True:
        edge = topology.edges(faces)
        length = np.linalg.norm(vertices[edge[:, 0]] - vertices[edge[:, 1]], axis=1)
        order = np.argsort(length, kind="stable")
        todo = [(a, b) for a, b in edge[order[: np.count_nonzero(length < shortest)]].tolist() if (a, b) not in stuck]
        if not todo:
            return drop_unused(vertices, faces)
        collapsed = _collapse(vertices, faces, *todo[0])
        if collapsed is None:
            stuck.add(todo[0])
        else:
            vertices, faces = collapsed
            stuck.clear()


def _collapse(vertices: np.ndarray, faces: np.ndarray, a: int, b: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The mesh with vertex ``b`` drawn into ``a``, or None where that would spoil it."""
    border = topology.boundary_edges(faces)
    with_a, with_b = (faces == a).any(axis=1), (faces == b).any(axis=1)
    shared = with_a & with_b
    on_border = [bool((border == v).any()) for v in (a, b)]
    if all(on_border) and shared.sum() == 2:  # joins two borders, or pinches one
        return None
    if len(np.intersect1d(faces[with_a], faces[with_b])) != 2 + shared.sum():
        return None
    place = vertices[a] if on_border == [True, False] else vertices[b] if on_border == [False, True] else None
    moved = vertices.copy()
    moved[a] = 0.5 * (vertices[a] + vertices[b]) if place is None else place
    ring = (with_a | with_b) & ~shared
    turned = np.where(faces == b, a, faces)
    normal = topology.face_normals(vertices, faces[ring])
    whole = topology.face_areas(vertices, faces[ring]) > 0
    if ((topology.face_normals(moved, turned[ring]) * normal).sum(axis=1)[whole] <= 0).any():
        return None
    return moved, turned[~shared]


def drop_unused(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same faces over only the vertices that they use."""
    used, flat = np.unique(faces, return_inverse=True)
    return vertices[used], flat.reshape(faces.shape)
