"""Connectivity and per-element measures of triangle meshes, in numpy.

Faces are (F, 3) integer arrays of vertex indices, wound counter-clockwise seen from outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NO_AREA, NO_HEIGHT = 1e-6, 1e-4
"""Least area of a face, as a share of their median, and least height over its longest side: less is what rounding
leaves of none, be it that of a file with six decimals."""


def half_edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges (3F, 2); half-edge ``3 f + k`` runs from corner ``k`` of face ``f`` to the next corner."""
    faces = np.asarray(faces)
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)


def edges(faces: np.ndarray) -> np.ndarray:
    """Undirected edges (E, 2), each once, lower index first, in lexicographic order."""
    code, base = _coded(np.sort(half_edges(faces), axis=1))
    return _pairs(np.unique(code), base)


def _coded(pairs: np.ndarray) -> tuple[np.ndarray, int]:
    """One integer (N,) for each pair of indices (N, 2), ordered as they are, and its base: sorted ten times faster."""
    base = int(pairs.max(initial=0)) + 1
    return pairs[:, 0].astype(np.int64) * base + pairs[:, 1], base


def _pairs(code: np.ndarray, base: int) -> np.ndarray:
    """The pairs of indices (N, 2) that :func:`_coded` made ``code`` (N,) of."""
    return np.stack(np.divmod(code, base), axis=1)


def hinges(faces: np.ndarray) -> np.ndarray:
    """Interior edges with their two wings, (H, 4) vertex indices.

    Columns: edge start a, edge end b, the corner opposite in the first face (which contains a -> b), the corner
    opposite in the second face (which contains b -> a). The dihedral angle is signed by this order.

    Raises
        ValueError: if an edge has more than two faces or two faces disagree on its direction.
    """
    return np.concatenate(_paired(faces)[:2], axis=1)


def hinge_faces(faces: np.ndarray) -> np.ndarray:
    """The two faces (H, 2) of each hinge, in the order of :func:`hinges`."""
    return _paired(faces)[2]


def _paired(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edge ends (H, 2), opposite corners (H, 2) and faces (H, 2) of interior edges, in edge order."""
    faces = np.asarray(faces)
    directed = half_edges(faces)
    if any(edge.size for edge in _shared_wrongly(directed)):
        raise ValueError(f"hinges need an oriented manifold mesh: {check_manifold(faces).describe()}")
    code, _ = _coded(np.sort(directed, axis=1))
    order = np.argsort(2 * code + (directed[:, 0] > directed[:, 1]), kind="stable")
    same = code[order[1:]] == code[order[:-1]]
    first, second = order[:-1][same], order[1:][same]
    opposite = np.roll(faces, -2, axis=1).reshape(-1)
    wings = np.stack([opposite[first], opposite[second]], axis=1)
    return directed[first], wings, np.stack([first // 3, second // 3], axis=1)


@dataclass(frozen=True)
class Defects:
    """What keeps a mesh from being an oriented manifold with boundary; every array is empty where all is well."""

    edges: np.ndarray
    """Edges (N, 2) shared by more than two faces."""
    flipped: np.ndarray
    """Edges (N, 2) whose two faces run along them in the same direction."""
    vertices: np.ndarray
    """Vertices (N,) whose faces form more than one fan."""
    degenerate: np.ndarray
    """Faces (N,) that repeat a vertex."""
    unused: np.ndarray
    """Vertices (N,) in no face."""

    def __bool__(self) -> bool:
        return any(part.size for part in (self.edges, self.flipped, self.vertices, self.degenerate, self.unused))

    def describe(self) -> str:
        """One line for a human, with the first offender of each kind."""
        kinds = {
            "edges with more than two faces": self.edges,
            "edges whose two faces are wound in opposite senses": self.flipped,
            "vertices where separate fans of faces touch": self.vertices,
            "faces that repeat a vertex": self.degenerate,
            "vertices in no face": self.unused,
        }
        parts = [f"{len(a)} {name} (first: {np.ravel(a[0]).tolist()})" for name, a in kinds.items() if a.size]
        return "; ".join(parts) or "no defects"


def check_manifold(faces: np.ndarray, vertex_count: int | None = None) -> Defects:
    """Defects of the mesh as an oriented manifold with boundary; falsy when there are none."""
    faces = np.asarray(faces)
    crowded, flipped = _shared_wrongly(half_edges(faces))
    degenerate = np.flatnonzero((faces == np.roll(faces, 1, axis=1)).any(axis=1))
    used = np.unique(faces)
    everything = np.arange(used[-1] + 1 if vertex_count is None else vertex_count)
    return Defects(
        edges=crowded,
        flipped=flipped,
        vertices=_pinched(faces),
        degenerate=degenerate,
        unused=np.setdiff1d(everything, used) if vertex_count is not None else np.zeros(0, np.int64),
    )


def _shared_wrongly(directed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (N, 2) of more than two of the half-edges ``directed``, and those of two in the same direction."""
    code, base = _coded(np.sort(directed, axis=1))
    edge, inverse, count = np.unique(code, return_inverse=True, return_counts=True)
    forward = np.bincount(inverse, weights=directed[:, 0] < directed[:, 1], minlength=len(edge))
    return _pairs(edge[count > 2], base), _pairs(edge[(count == 2) & (forward != 1)], base)


def _pinched(faces: np.ndarray) -> np.ndarray:
    """Vertices whose faces form more than one fan: corners are joined across edges and counted per vertex."""
    corner_vertex = faces.reshape(-1)
    count = len(corner_vertex)
    a = np.arange(count).reshape(-1, 3)
    b = np.roll(a, -1, axis=1)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    corners = np.stack([a, b], axis=-1).reshape(-1, 2)
    swap = ends[:, 0] > ends[:, 1]
    ends[swap], corners[swap] = ends[swap][:, ::-1], corners[swap][:, ::-1]
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    same = np.all(ends[order[1:]] == ends[order[:-1]], axis=1)
    one, two = corners[order[:-1][same]], corners[order[1:][same]]
    label = connected_labels(count, np.concatenate([np.stack([one[:, k], two[:, k]], 1) for k in (0, 1)]))
    code, base = _coded(np.stack([corner_vertex, label], axis=1))
    fans = _pairs(np.unique(code), base)[:, 0]
    return np.flatnonzero(np.bincount(fans) > 1)


def connected_labels(count: int, pairs: np.ndarray) -> np.ndarray:
    """Component label (count,) of each node of the undirected graph with edges ``pairs`` (N, 2); the smallest index.

    Label propagation with pointer jumping: a few array passes instead of a Python union-find.
    """
    label = np.arange(count)
    while True:
        low = label.copy()
        smaller = np.minimum(label[pairs[:, 0]], label[pairs[:, 1]])
        np.minimum.at(low, label[pairs[:, 0]], smaller)
        np.minimum.at(low, label[pairs[:, 1]], smaller)
        low = low[low]
        while not np.array_equal(low, low[low]):
            low = low[low]
        moved = low[label]
        if np.array_equal(moved, label):
            return label
        label = moved


def components(faces: np.ndarray) -> list[np.ndarray]:
    """Face indices of each edge-or-vertex-connected component, the one with most faces first."""
    faces = np.asarray(faces)
    label = connected_labels(int(faces.max()) + 1, half_edges(faces))[faces[:, 0]]
    parts = [np.flatnonzero(label == value) for value in np.unique(label)]
    return sorted(parts, key=len, reverse=True)


def consistent_winding(faces: np.ndarray) -> np.ndarray:
    """Which faces (F,) to turn over so that neighbours agree, keeping each component's majority as it is, and of two
    halves one."""
    faces = np.asarray(faces)
    directed = half_edges(faces)
    key = np.sort(directed, axis=1)
    order = np.lexsort((key[:, 1], key[:, 0]))
    same = np.all(key[order[1:]] == key[order[:-1]], axis=1)
    one, two = order[:-1][same], order[1:][same]
    agree = directed[one, 0] != directed[two, 0]
    # nodes f and F + f stand for face f kept and turned: joined across an edge in the combinations that agree
    count = len(faces)
    f, g = one // 3, two // 3
    kept = np.stack([f, np.where(agree, g, g + count)], axis=1)
    turned = np.stack([f + count, np.where(agree, g + count, g)], axis=1)
    label = connected_labels(2 * count, np.concatenate([kept, turned]))
    size = np.bincount(label[:count], minlength=2 * count)
    kept, turned = label[:count], label[count:]
    return (size[kept] < size[turned]) | ((size[kept] == size[turned]) & (kept > turned))


def boundary_edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges (E, 2) that one face alone has, in its winding."""
    directed = half_edges(faces)
    code, _ = _coded(np.sort(directed, axis=1))
    _, inverse, count = np.unique(code, return_inverse=True, return_counts=True)
    return directed[count[inverse] == 1]


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Closed boundary curves as vertex indices, each following its faces' winding, the longest first.

    Raises
        ValueError: if a boundary vertex has two outgoing boundary edges (the mesh is pinched there).
    """
    border = boundary_edges(faces)
    following = dict(border.tolist())
    if len(following) != len(border):
        raise ValueError("boundary_loops needs a mesh whose boundary vertices have one boundary edge out of each")
    loops = []
    while following:
        start, vertex = following.popitem()
        loop = [start]
        while vertex != start:
            loop.append(vertex)
            vertex = following.pop(vertex)
        loops.append(np.array(loop))
    return sorted(loops, key=lambda loop: (-len(loop), loop.min()))


def face_areas(points: np.ndarray, faces: np.ndarray | None = None) -> np.ndarray:
    """Areas (F,) of triangles: ``points`` are vertices (V, 2|3) with ``faces``, or corners (F, 3, 2|3) without."""
    corner = points if faces is None else points[faces]
    a, b = corner[..., 1, :] - corner[..., 0, :], corner[..., 2, :] - corner[..., 0, :]
    cross = (a * a).sum(-1) * (b * b).sum(-1) - (a * b).sum(-1) ** 2
    return 0.5 * np.sqrt(np.maximum(cross, 0.0))


def without_area(corners: np.ndarray) -> np.ndarray:
    """Triangles, of corners (F, 3, 2|3), that have no area but what rounding leaves."""
    area = face_areas(corners)
    longest = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=-1).max(axis=1)
    return np.flatnonzero((area <= NO_AREA * np.median(area)) | (2 * area <= NO_HEIGHT * longest))


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Outward unit normals (F, 3); zero for a triangle without area."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


def face_angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Interior angles (F, 3) [rad] at each corner."""
    corner = vertices[faces]
    a = np.roll(corner, -1, axis=1) - corner
    b = np.roll(corner, -2, axis=1) - corner
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.arctan2(cross, (a * b).sum(-1))


def vertex_areas(areas: np.ndarray, faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """Area (V,) of each vertex: a third of each of its faces'."""
    return np.bincount(np.ravel(faces), weights=np.repeat(areas / 3.0, 3), minlength=vertex_count)


def vertex_masses(areas: np.ndarray, faces: np.ndarray, vertex_count: int, density: float) -> np.ndarray:
    """Lumped masses (V,) [kg] of cloth of area ``density`` [kg/m^2] with rest ``areas`` (F,) [m^2]."""
    return density * vertex_areas(areas, faces, vertex_count)
