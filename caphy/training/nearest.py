"""Nearest points of many posed bodies at once: what the contact loss needs of every vertex of every frame.

Exact nearest vertex by branch and bound over clusters of body vertices that stay together in any pose, then the
exact nearest point on the triangles around it. On meshes without slivers that is the nearest point of the surface.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit

CLUSTER = 24
"""Body vertices per cluster, about the square root of their number."""


@dataclass(frozen=True)
class NearestFields:
    """Nearest body points of positions (N, V, 3), float32.

    point (N, V, 3) [m]; normal (N, V, 3) the outward gradient of the signed distance; face (N, V); barycentric
    (N, V, 3); distance (N, V) [m], negative inside.
    """

    point: np.ndarray
    normal: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray
    distance: np.ndarray


class BodySearch:
    """Search structure of one body mesh: depends on its rest shape only, serves every pose."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """``vertices`` (B, 3) [m] at rest and ``faces`` (F, 3)."""
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        self.members, self.cluster_start = _clusters(vertices, max(1, len(vertices) // CLUSTER))
        order = np.argsort(faces.ravel(), kind="stable")
        self.around = (order // 3).astype(np.int32)
        counts = np.bincount(faces.ravel(), minlength=len(vertices))
        self.around_start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)

    def nearest(self, points: np.ndarray, bodies: np.ndarray) -> NearestFields:
        """Nearest points of positions (N, V, 3) on the body posed as ``bodies`` (N, B, 3) [m], frame by frame."""
        points, bodies = (np.ascontiguousarray(a, dtype=np.float32) for a in (points, bodies))
        n, v = points.shape[:2]
        found = NearestFields(
            np.empty((n, v, 3), np.float32),
            np.empty((n, v, 3), np.float32),
            np.empty((n, v), np.int32),
            np.empty((n, v, 3), np.float32),
            np.empty((n, v), np.float32),
        )

        def run(part: np.ndarray) -> None:
            for frame in part:
                _nearest_frame(
                    points[frame],
                    bodies[frame],
                    self.faces,
                    self.members,
                    self.cluster_start,
                    self.around,
                    self.around_start,
                    found.point[frame],
                    found.normal[frame],
                    found.face[frame],
                    found.barycentric[frame],
                    found.distance[frame],
                )

        threads = min(torch.get_num_threads(), n)
        if threads == 1:
            run(np.arange(n))
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(run, np.array_split(np.arange(n), threads)))
        return found

    def interpolated(self, found: NearestFields, bodies: np.ndarray) -> np.ndarray:
        """Where bodies (N, B, 3) posed otherwise have the nearest points, (N, V, 3) [m]."""
        corners = np.take_along_axis(
            bodies, self.faces[found.face].reshape(len(bodies), -1, 1).astype(np.int64), axis=1
        ).reshape(*found.face.shape, 3, 3)
        return np.einsum("nvk,nvkc->nvc", found.barycentric, corners)


def _clusters(vertices: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (B,) ordered by cluster, and where each begins (count + 1,): farthest points, then nearest seed."""
    seeds, distance = [0], np.full(len(vertices), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, np.linalg.norm(vertices - vertices[seeds[-1]], axis=1))
        seeds.append(int(distance.argmax()))
    label = np.linalg.norm(vertices[:, None] - vertices[seeds], axis=2).argmin(1)
    order = np.argsort(label, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(label, minlength=count))])
    return order.astype(np.int32), starts.astype(np.int32)


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "arcp", "nsz"})
def _nearest_frame(
    points, body, faces, members, cluster_start, around, around_start, out_point, out_normal, out_face, out_bary, out_d
):
    clusters = len(cluster_start) - 1
    normals = _vertex_normals(body, faces)
    packed = np.empty((len(members), 3), np.float32)
    for i in range(len(members)):
        packed[i] = body[members[i]]
    centre = np.zeros((clusters, 3), np.float32)
    radius = np.zeros(clusters, np.float32)
    for c in range(clusters):
        first, last = cluster_start[c], cluster_start[c + 1]
        for i in range(first, last):
            for axis in range(3):
                centre[c, axis] += packed[i, axis] / (last - first)
        for i in range(first, last):
            away = _minus(_row(packed, i), _row(centre, c))
            radius[c] = max(radius[c], np.sqrt(_dot(away, away)))
    bound = np.empty(clusters, np.float32)
    for v in range(len(points)):
        x, y, z = points[v, 0], points[v, 1], points[v, 2]
        likely, least = 0, np.float32(np.inf)
        for c in range(clusters):
            dx, dy, dz = x - centre[c, 0], y - centre[c, 1], z - centre[c, 2]
            bound[c] = np.sqrt(dx * dx + dy * dy + dz * dz)
            if bound[c] < least:
                least, likely = bound[c], c
        best, square = _scan(x, y, z, packed, cluster_start[likely], cluster_start[likely + 1], 0, np.float32(np.inf))
        reach = np.sqrt(square)
        for c in range(clusters):
            if c != likely and bound[c] - radius[c] < reach:
                best, square = _scan(x, y, z, packed, cluster_start[c], cluster_start[c + 1], best, square)
                reach = np.sqrt(square)
        _on_faces(
            (x, y, z), body, faces, normals, around, around_start, members[best], v,
            out_point, out_normal, out_face, out_bary, out_d,
        )  # fmt: skip


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "arcp", "nsz"})
def _scan(x, y, z, packed, first, last, best, square):
    for i in range(first, last):
        dx, dy, dz = x - packed[i, 0], y - packed[i, 1], z - packed[i, 2]
        d = dx * dx + dy * dy + dz * dz
        if d < square:
            best, square = i, d
    return best, square


@njit(cache=True, nogil=True, inline="always")
def _on_faces(
    p, body, faces, normals, around, around_start, vertex, v, out_point, out_normal, out_face, out_bary, out_d
):
    """The nearest point on the triangles around a body vertex; vectors are tuples, which stay in registers."""
    square = np.float32(np.inf)
    q, bary, face = p, p, 0
    for k in range(around_start[vertex], around_start[vertex + 1]):
        f = around[k]
        a, b, c = _row(body, faces[f, 0]), _row(body, faces[f, 1]), _row(body, faces[f, 2])
        weights = _barycentric(p, a, b, c)
        candidate = _mix(weights, a, b, c)
        away = _minus(p, candidate)
        d = _dot(away, away)
        if d < square:
            square, q, bary, face = d, candidate, weights, f
    a, b, c = _row(normals, faces[face, 0]), _row(normals, faces[face, 1]), _row(normals, faces[face, 2])
    normal = _mix(bary, a, b, c)
    away = _minus(p, q)
    distance = np.sqrt(square)
    sign = np.float32(1.0) if _dot(away, normal) >= 0 else np.float32(-1.0)
    if distance > 1e-5:
        normal, scale = away, sign / distance
    else:
        scale = np.float32(1.0) / np.sqrt(_dot(normal, normal))
    out_d[v], out_face[v] = sign * distance, face
    for axis in range(3):
        out_point[v, axis], out_bary[v, axis], out_normal[v, axis] = q[axis], bary[axis], normal[axis] * scale


@njit(cache=True, nogil=True, inline="always")
def _barycentric(p, a, b, c):  # noqa: PLR0911
    """Barycentric coordinates of the nearest point of a triangle (Ericson, Real-Time Collision Detection, 5.1.5)."""
    zero, one = np.float32(0), np.float32(1)
    ab, ac, ap = _minus(b, a), _minus(c, a), _minus(p, a)
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0 and d2 <= 0:
        return one, zero, zero
    bp = _minus(p, b)
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0 and d4 <= d3:
        return zero, one, zero
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        t = d1 / (d1 - d3)
        return one - t, t, zero
    cp = _minus(p, c)
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0 and d5 <= d6:
        return zero, zero, one
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        t = d2 / (d2 - d6)
        return one - t, zero, t
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return zero, one - t, t
    scale = one / (va + vb + vc)
    return one - (vb + vc) * scale, vb * scale, vc * scale


@njit(cache=True, nogil=True, inline="always")
def _row(array, i):
    return array[i, 0], array[i, 1], array[i, 2]


@njit(cache=True, nogil=True, inline="always")
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, nogil=True, inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True, inline="always")
def _mix(w, a, b, c):
    return (
        w[0] * a[0] + w[1] * b[0] + w[2] * c[0],
        w[0] * a[1] + w[1] * b[1] + w[2] * c[1],
        w[0] * a[2] + w[1] * b[2] + w[2] * c[2],
    )


@njit(cache=True, nogil=True)
def _vertex_normals(body, faces):
    """Unit normals (B, 3), faces weighted by their angle at the vertex (Baerentzen and Aanaes, TVCG 2005)."""
    normals = np.zeros_like(body)
    for f in range(len(faces)):
        for k in range(3):
            i = faces[f, k]
            corner = _row(body, i)
            u, w = _minus(_row(body, faces[f, (k + 1) % 3]), corner), _minus(_row(body, faces[f, (k + 2) % 3]), corner)
            n = (u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0])
            length = np.sqrt(_dot(n, n))
            if length > 0:
                weight = np.arctan2(length, _dot(u, w)) / length
                for axis in range(3):
                    normals[i, axis] += n[axis] * weight
    for i in range(len(body)):
        n = _row(normals, i)
        length = np.sqrt(_dot(n, n))
        if length > 0:
            normals[i] /= length
    return normals
