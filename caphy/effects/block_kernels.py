"""Compiled loops that add element Hessians to the 3x3 blocks of a sparse matrix.

``slots`` (n, k, k) has the place among ``blocks`` (B, 3, 3) [N/m] of each pair of an element's corners, or -1 where the
pair is not stored because the matrix is symmetric.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from caphy.effects.hinge import COLLAPSED
from caphy.effects.kernels import (
    _compiled,
    _cross,
    _deformation,
    _dot,
    _hinge,
    _inlined,
    _minus,
    _turn,
    _vertex,
    angle_then,
    projected,
    unit_normal,
    velocity_of_face,
)


@_compiled()
def scatter(hessian, slots, blocks):
    """Add any element Hessians (k, 3, k, 3, n)."""
    for a in range(hessian.shape[0]):
        for b in range(hessian.shape[2]):
            for i in range(hessian.shape[4]):
                slot = slots[i, a, b]
                if slot >= 0:
                    for p in range(3):
                        for q in range(3):
                            blocks[slot, p, q] += hessian[a, p, b, q, i]


@_compiled()
def membrane(x, index, hat, area, stress, tangent, slots, blocks):
    """Add A [(w_a^T S w_b) I + B_a^T C B_b] for faces of stress (3, n) and tangent (6, n), as in effects.membrane."""
    room = np.empty((2, 3, 3, 3))
    for i in range(index.shape[0]):
        u, v, _, _, _ = _deformation(x, 0, index, hat, i)
        s = (stress[0, i], stress[1, i], stress[2, i])
        c = (tangent[0, i], tangent[1, i], tangent[2, i], tangent[3, i], tangent[4, i], tangent[5, i])
        _add_face(i, u, v, hat, area[i], s, c, room, slots, blocks)


@_compiled()
def strain_stvk(x, index, hat, area, lame_lambda, lame_mu, projection, slots, blocks):
    """Add faces of effects.strain_stvk."""
    room = np.empty((2, 3, 3, 3))
    direct = lame_lambda + 2.0 * lame_mu
    tangent = (direct, direct, lame_mu, lame_lambda, 0.0, 0.0)
    for i in range(index.shape[0]):
        u, v, uu, vv, uv = _deformation(x, 0, index, hat, i)
        pressure = lame_lambda * (uu + vv)
        stress = (pressure + 2.0 * lame_mu * uu, pressure + 2.0 * lame_mu * vv, 2.0 * lame_mu * uv)
        if projection > 0.0:
            stress = _tensile(stress, projection)
        _add_face(i, u, v, hat, area[i], stress, tangent, room, slots, blocks)


@_inlined()
def _tensile(stress, share):
    """A mixture of a stress and, by ``share``, what is left of it without compression; as membrane.positive_part."""
    uu, vv, uv = stress
    mean, half = 0.5 * (uu + vv), 0.5 * (uu - vv)
    radius = sqrt(half * half + uv * uv)
    low, high = max(mean - radius, 0.0), max(mean + radius, 0.0)
    middle, ratio = 0.5 * (low + high), 0.5 * (high - low) / max(radius, 1e-300)
    return (
        uu + share * (middle + ratio * half - uu),
        vv + share * (middle - ratio * half - vv),
        uv + share * (ratio * uv - uv),
    )


@_inlined()
def _add_face(i, u, v, hat, area, stress, tangent, room, slots, blocks):
    """Add a face whose deformation gradient has the columns u and v."""
    rows, stiff = room[0], room[1]
    c00, c11, c22, c01, c02, c12 = tangent
    for a in range(3):
        wu, wv = hat[a, 0, i], hat[a, 1, i]
        for p in range(3):
            b0, b1, b2 = wu * u[p], wv * v[p], wu * v[p] + wv * u[p]
            rows[a, 0, p], rows[a, 1, p], rows[a, 2, p] = b0, b1, b2
            stiff[a, 0, p] = area * (c00 * b0 + c01 * b1 + c02 * b2)
            stiff[a, 1, p] = area * (c01 * b0 + c11 * b1 + c12 * b2)
            stiff[a, 2, p] = area * (c02 * b0 + c12 * b1 + c22 * b2)
    for a in range(3):
        along = area * (stress[0] * hat[a, 0, i] + stress[2] * hat[a, 1, i])
        across = area * (stress[2] * hat[a, 0, i] + stress[1] * hat[a, 1, i])
        for b in range(3):
            slot = slots[i, a, b]
            if slot < 0:
                continue
            for p in range(3):
                for q in range(3):
                    blocks[slot, p, q] += (
                        rows[a, 0, p] * stiff[b, 0, q] + rows[a, 1, p] * stiff[b, 1, q] + rows[a, 2, p] * stiff[b, 2, q]
                    )
                blocks[slot, p, p] += along * hat[b, 0, i] + across * hat[b, 1, i]


@_compiled()
def angles(x, index, found):
    """Write the dihedral angles of hinges to ``found`` (n,) [rad]."""
    for i in range(index.shape[0]):
        found[i] = _hinge(x, 0, index, i)[5]


@_compiled()
def hinge(x, index, length, area, moment, stiffness, slots, blocks):
    """Add ``moment`` times the second derivative of each angle and ``stiffness`` times the square of its first."""
    slope = np.empty((4, 3))
    for i in range(index.shape[0]):
        _add_hinge(_hinge(x, 0, index, i), length[i], area[i], moment[i], stiffness[i], slope, slots[i], blocks)


@_compiled()
def bending(x, index, stiffness, rest_angle, length, area, projection, slots, blocks):
    """Add hinges of effects.bending, and of effects that make some of them less stiff."""
    slope = np.empty((4, 3))
    for i in range(index.shape[0]):
        found = _hinge(x, 0, index, i)
        moment = 2.0 * (1.0 - projection) * stiffness[i] * _turn(found[5], rest_angle[i])
        stiff = 2.0 * (stiffness[i] if stiffness[i] > 0.0 else (1.0 - projection) * stiffness[i])
        _add_hinge(found, length[i], area[i], moment, stiff, slope, slots[i], blocks)


@_compiled()
def bending_damping(x, start, lagged, index, stiffness, length, area, lead, projection, slots, blocks):
    """Add hinges of effects.bending_damping: bending whose rest angles are those before the step."""
    slope = np.empty((4, 3))
    for i in range(index.shape[0]):
        found = _hinge(x, 0, index, i)
        moment = 2.0 * (1.0 - projection) * stiffness[i] * _turn(found[5], angle_then(start, lagged, 0, index, i, lead))
        _add_hinge(found, length[i], area[i], moment, 2.0 * stiffness[i], slope, slots[i], blocks)


@_inlined()
def _add_hinge(found, length, area, moment, stiffness, slope, slots, blocks):
    edge, wing_c, wing_d, normal_c, normal_d, _ = found
    square = max(_dot(edge, edge), (COLLAPSED * length) ** 2)
    smallest, reach = (COLLAPSED * area) ** 2, sqrt(square)
    along_c, along_d = _dot(wing_c, edge) / square, _dot(wing_d, edge) / square
    at_c = -reach / max(_dot(normal_c, normal_c), smallest)
    at_d = -reach / max(_dot(normal_d, normal_d), smallest)
    for p in range(3):
        slope[2, p], slope[3, p] = at_c * normal_c[p], at_d * normal_d[p]
        slope[1, p] = -along_c * slope[2, p] - along_d * slope[3, p]
        slope[0, p] = (along_c - 1.0) * slope[2, p] + (along_d - 1.0) * slope[3, p]
    for a in range(4):
        for b in range(4):
            slot = slots[a, b]
            if slot >= 0:
                for p in range(3):
                    for q in range(3):
                        blocks[slot, p, q] += stiffness * slope[a, p] * slope[b, q]
    if moment != 0.0:
        edge = (edge[0] / reach, edge[1] / reach, edge[2] / reach)
        _add_second(2, edge, reach, normal_c, _cross(normal_c, edge), along_c, smallest, moment, slots, blocks)
        _add_second(3, edge, reach, normal_d, _cross(edge, normal_d), along_d, smallest, moment, slots, blocks)


@_inlined()
def _add_second(wing, edge, reach, normal, inward, along, smallest, moment, slots, blocks):
    """Add what one triangle of a hinge contributes to ``moment`` times the angle's second derivative.

    With the unit vectors e along the edge, n across the triangle and m = n x e towards its wing, its height h, the
    edge's length l and the wing's place t along it, the wing's slope is -n / h, and

        dn = -m (n.dw) / h + (t m / h - e / l) (n.de),    dh = m.(dw - t de)

    for moves dw of the wing and de of the edge's second end, both against its first. So the edge's ends and the wing,
    in that order, have the blocks

        (u u^T + h^2 / (2 l^2) s s^T) S + u s^T E + s u^T E^T,    u = (t - 1, -t, 1), s = (-1, 1, 0),

    with S = (m n^T + n m^T) / h^2 and E = e n^T / (h l). A part m n^T - n m^T of the edge's own is left out, since the
    hinge's other triangle has the opposite. Where the triangle has collapsed nothing is added.
    """
    area = _dot(normal, normal)
    if area <= smallest:
        return
    height = sqrt(area) / reach
    outer, cross = moment / (area * height * height), moment / (sqrt(area) * height * reach)
    both = 0.5 * (height / reach) ** 2
    for j in range(3):
        a, u_a, s_a = _corner(j, wing, along)
        for k in range(3):
            b, u_b, s_b = _corner(k, wing, along)
            slot = slots[a, b]
            if slot < 0:
                continue
            same, here, there = outer * (u_a * u_b + both * s_a * s_b), cross * u_a * s_b, cross * s_a * u_b
            for p in range(3):
                along_normal = same * inward[p] + here * edge[p]
                along_inward, along_edge = same * normal[p], there * normal[p]
                for q in range(3):
                    blocks[slot, p, q] += along_normal * normal[q] + along_inward * inward[q] + along_edge * edge[q]


@_inlined()
def _corner(j, wing, along):
    """Of the ends of an edge and a wing, the place in the hinge, and u and s as in :func:`_add_second`."""
    if j == 0:
        return 0, along - 1.0, -1.0
    if j == 1:
        return 1, -along, 1.0
    return wing, 1.0, 0.0


@_compiled()
def spring(x, anchor, index, stiffness, projection, slots, blocks):
    """Add vertex springs of a stiffness [N/m], wherever they are tied to."""
    for i in range(index.shape[0]):
        for p in range(3):
            blocks[slots[i, 0, 0], p, p] += stiffness[i]


@_compiled()
def body_contact(x, point, normal, index, area, layer, stiffness, distance, projection, slots, blocks):
    """Add vertices of effects.body_contact; projected ones, inside the body, wherever projection is not zero."""
    for i in range(index.shape[0]):
        a = index[i, 0]
        away, skin = _vertex(normal, 0, a), distance + layer[i]
        deep = skin - _dot(away, _minus(_vertex(x, 0, a), _vertex(point, 0, a)))
        if deep <= 0.0:
            continue
        slope = deep
        if not deep < skin:
            slope = skin * skin / max(deep, 1e-12) if projection > 0.0 else 0.0
        slope *= 6.0 * stiffness * area[i]
        for p in range(3):
            for q in range(3):
                blocks[slots[i, 0, 0], p, q] += slope * away[p] * away[q]


@_compiled()
def air(x, origin, lagged, index, area, dt, across, power, drag, wind, push, projection, slots, blocks):
    """Add faces of effects.air with a drag law; the same between all pairs of corners."""
    if power == 0:
        return
    blown = (wind[0], wind[1], wind[2])
    for i in range(index.shape[0]):
        normal = unit_normal(lagged, 0, index, i)
        slip = projected(_minus(velocity_of_face(x, origin, 0, index, i, dt), blown), normal, across)
        speed = max(sqrt(_dot(slip, slip)), 1e-12)
        growth = area[i] / (9.0 * dt) * drag * (speed if power == 2 else 1.0)
        steeper = (power - 1.0) / (speed * speed)
        for p in range(3):
            for q in range(3):
                plane = normal[p] * normal[q]
                if not across:
                    plane = (1.0 if p == q else 0.0) - plane
                entry = growth * (plane + steeper * slip[p] * slip[q])
                for a in range(3):
                    for b in range(3):
                        if slots[i, a, b] >= 0:
                            blocks[slots[i, a, b], p, q] += entry
