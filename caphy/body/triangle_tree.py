"""Compiled kernels: a bounding-volume tree over triangles, refitted to moving vertices, and exact nearest points.

The tree is a complete binary heap (node k has children 2k and 2k + 1, the root is 1), split once at the median of the
longest side; for moving vertices only its boxes are recomputed. Closest points follow Ericson, Real-Time Collision
Detection, section 5.1.5; signs the angle-weighted pseudonormals of Baerentzen and Aanaes, IEEE TVCG 2005.
"""

from __future__ import annotations

import numpy as np

from caphy.jit import compiled

ON_SURFACE = 1e-10
"""Below this distance [m] the direction to the nearest point is rounding noise; the pseudonormal is answered."""
ON_SIDE = 1e-9
"""Below this weight of the corner across from it a point lies on a side: what is left is rounding noise."""

_STACK = 64


@compiled(nogil=True)
def build_order(centres, leaves):
    """Faces (F,) in the order of the tree's ``leaves`` (a power of two), and the leaf bounds (leaves + 1,)."""
    order = np.arange(len(centres))
    bounds = np.array([i * len(centres) // leaves for i in range(leaves + 1)])
    width = leaves
    while width > 1:
        for first in range(0, leaves, width):
            start, stop = bounds[first], bounds[first + width]
            part = centres[order[start:stop]]
            spread = np.array([np.ptp(part[:, axis]) for axis in range(3)])
            order[start:stop] = order[start:stop][np.argsort(part[:, np.argmax(spread)])]
        width //= 2
    return order, bounds


@compiled(nogil=True)
def refit(vertices, faces, order, bounds, low, high):
    """Recompute the boxes ``low``, ``high`` (2 * leaves, 3) in place for moved ``vertices``."""
    leaves = len(bounds) - 1
    for leaf in range(leaves):
        for axis in range(3):
            least, most = np.inf, -np.inf
            for place in range(bounds[leaf], bounds[leaf + 1]):
                for corner in range(3):
                    value = vertices[faces[order[place], corner], axis]
                    least, most = min(least, value), max(most, value)
            low[leaves + leaf, axis], high[leaves + leaf, axis] = least, most
    for node in range(leaves - 1, 0, -1):
        for axis in range(3):
            low[node, axis] = min(low[2 * node, axis], low[2 * node + 1, axis])
            high[node, axis] = max(high[2 * node, axis], high[2 * node + 1, axis])


@compiled(nogil=True, inline="always")
def _box_square(x, y, z, low, high, node):
    dx = max(low[node, 0] - x, 0.0, x - high[node, 0])
    dy = max(low[node, 1] - y, 0.0, y - high[node, 1])
    dz = max(low[node, 2] - z, 0.0, z - high[node, 2])
    return dx * dx + dy * dy + dz * dz


@compiled(nogil=True)
def _closest_on_triangle(px, py, pz, vertices, i, j, k):
    """Squared distance and barycentric weights of the point of triangle (i, j, k) nearest to p.

    Weights are exactly zero where the point lies on an edge or a corner: the pseudonormal depends on it. A triangle
    without area is its edges.
    """
    ax, ay, az = vertices[i, 0], vertices[i, 1], vertices[i, 2]
    abx, aby, abz = vertices[j, 0] - ax, vertices[j, 1] - ay, vertices[j, 2] - az
    acx, acy, acz = vertices[k, 0] - ax, vertices[k, 1] - ay, vertices[k, 2] - az
    apx, apy, apz = px - ax, py - ay, pz - az
    bpx, bpy, bpz = apx - abx, apy - aby, apz - abz
    cpx, cpy, cpz = apx - acx, apy - acy, apz - acz
    d1, d2 = abx * apx + aby * apy + abz * apz, acx * apx + acy * apy + acz * apz
    d3, d4 = abx * bpx + aby * bpy + abz * bpz, acx * bpx + acy * bpy + acz * bpz
    d5, d6 = abx * cpx + aby * cpy + abz * cpz, acx * cpx + acy * cpy + acz * cpz
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0 and d2 <= 0:
        u, v, w = 1.0, 0.0, 0.0
    elif d3 >= 0 and d4 <= d3:
        u, v, w = 0.0, 1.0, 0.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0 and d1 > d3:
        v, w = d1 / (d1 - d3), 0.0
        u = 1 - v
    elif d6 >= 0 and d5 <= d6:
        u, v, w = 0.0, 0.0, 1.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0 and d2 > d6:
        v, w = 0.0, d2 / (d2 - d6)
        u = 1 - w
    elif va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0 and (d4 - d3) + (d5 - d6) > 0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        u, v = 0.0, 1 - w
    elif va + vb + vc > 0:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
        u = max(1 - v - w, 0.0)
    else:
        u, v, w = 1.0, 0.0, 0.0
    rx, ry, rz = apx - v * abx - w * acx, apy - v * aby - w * acy, apz - v * abz - w * acz
    return rx * rx + ry * ry + rz * rz, u, v, w


@compiled(nogil=True)
def _nearest_face(x, y, z, vertices, faces, order, bounds, low, high, guess, stack, reached):
    """Nearest face and the weights of the point on it; ``guess`` (a face, or -1) bounds the search from the start."""
    leaves = len(bounds) - 1
    best, face, u, v, w = np.inf, -1, 0.0, 0.0, 0.0
    if guess >= 0:
        face = guess
        best, u, v, w = _closest_on_triangle(x, y, z, vertices, faces[face, 0], faces[face, 1], faces[face, 2])
    top = 1
    stack[0], reached[0] = 1, 0.0
    while top > 0:
        top -= 1
        node = stack[top]
        if reached[top] >= best:
            continue
        if node >= leaves:
            for place in range(bounds[node - leaves], bounds[node - leaves + 1]):
                f = order[place]
                square, fu, fv, fw = _closest_on_triangle(x, y, z, vertices, faces[f, 0], faces[f, 1], faces[f, 2])
                if square < best:
                    best, face, u, v, w = square, f, fu, fv, fw
            continue
        near, far = 2 * node, 2 * node + 1
        near_square = _box_square(x, y, z, low, high, near)
        far_square = _box_square(x, y, z, low, high, far)
        if far_square < near_square:
            near, far, near_square, far_square = far, near, far_square, near_square
        if far_square < best:
            stack[top], reached[top] = far, far_square
            top += 1
        if near_square < best:
            stack[top], reached[top] = near, near_square
            top += 1
    return face, u, v, w


@compiled(nogil=True)
def _add_face_normal(vertices, faces, f, corner, normal):
    """Add face f's unit normal, times its angle at ``corner`` unless that is -1, to ``normal`` in place."""
    shift = max(corner, 0)
    a, b, c = faces[f, shift], faces[f, (shift + 1) % 3], faces[f, (shift + 2) % 3]
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    wx, wy, wz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if length > 0:
        scale = (1.0 if corner < 0 else np.arctan2(length, ux * wx + uy * wy + uz * wz)) / length
        normal[0] += scale * nx
        normal[1] += scale * ny
        normal[2] += scale * nz


@compiled(nogil=True)
def _pseudonormal(vertices, faces, neighbours, starts, incident, f, weights, normal):
    """Fill ``normal`` (not of unit length) of the face, edge or vertex of face f that ``weights`` (3,) lie on."""
    normal[:] = 0
    zeros = (weights[0] < ON_SIDE) + (weights[1] < ON_SIDE) + (weights[2] < ON_SIDE)
    if zeros == 2:
        vertex = faces[f, np.argmax(weights)]
        for place in range(starts[vertex], starts[vertex + 1]):
            _add_face_normal(vertices, faces, incident[place] // 3, incident[place] % 3, normal)
        return
    _add_face_normal(vertices, faces, f, -1, normal)
    if zeros == 1:
        other = neighbours[f, np.argmin(weights)]  # the face across the edge opposite to the corner of weight 0
        if other >= 0:
            _add_face_normal(vertices, faces, other, -1, normal)


@compiled(nogil=True)
def query(points, vertices, faces, order, bounds, low, high, neighbours, starts, incident, guess):
    """Nearest faces (N,), weights (N, 3), points (N, 3), normals (N, 3) and signed distances (N,) of points (N, 3)."""
    count = len(points)
    nearest = np.empty(count, np.int64)
    weights, nearest_points = np.empty((count, 3)), np.empty((count, 3))
    normals, distances = np.empty((count, 3)), np.empty(count)
    stack, reached = np.empty(_STACK, np.int64), np.empty(_STACK)
    offset = np.empty(3)
    for n in range(count):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        f, u, v, w = _nearest_face(x, y, z, vertices, faces, order, bounds, low, high, guess[n], stack, reached)
        nearest[n] = f
        weights[n, 0], weights[n, 1], weights[n, 2] = u, v, w
        _pseudonormal(vertices, faces, neighbours, starts, incident, f, weights[n], normals[n])
        square, dot, length = 0.0, 0.0, 0.0
        for axis in range(3):
            nearest_points[n, axis] = (
                weights[n, 0] * vertices[faces[f, 0], axis]
                + weights[n, 1] * vertices[faces[f, 1], axis]
                + weights[n, 2] * vertices[faces[f, 2], axis]
            )
            offset[axis] = points[n, axis] - nearest_points[n, axis]
            square += offset[axis] * offset[axis]
            dot += offset[axis] * normals[n, axis]
            length += normals[n, axis] * normals[n, axis]
        distance = np.sqrt(square) if dot >= 0 else -np.sqrt(square)
        distances[n] = distance
        if abs(distance) > ON_SURFACE:
            for axis in range(3):
                normals[n, axis] = offset[axis] / distance
        elif length > 0:
            for axis in range(3):
                normals[n, axis] /= np.sqrt(length)
    return nearest, weights, nearest_points, normals, distances
