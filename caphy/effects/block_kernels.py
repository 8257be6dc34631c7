"""Compiled loops that add element Hessians to the 3x3 blocks of a sparse matrix.

``slots`` (n, k, k) has the place among ``blocks`` (B, 3, 3) [N/m] of each pair of an element's corners, or -1 where the
pair is not stored because the matrix is symmetric.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from caphy.effects.hinge import COLLAPSED
from caphy.effects.kernels import _compiled, _cross, _deformation, _dot, _hinge


@_compiled
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


@_compiled
def membrane(x, index, hat, area, stress, tangent, slots, blocks):
    """Add A [(w_a^T S w_b) I + B_a^T C B_b] for faces of stress (3, n) and tangent (6, n), as in effects.membrane."""
    rows, stiff = np.empty((3, 3, 3)), np.empty((3, 3, 3))
    for i in range(index.shape[0]):
        u, v, _, _, _ = _deformation(x, 0, index, hat, i)
        c00, c11, c22 = tangent[0, i], tangent[1, i], tangent[2, i]
        c01, c02, c12 = tangent[3, i], tangent[4, i], tangent[5, i]
        for a in range(3):
            wu, wv = hat[a, 0, i], hat[a, 1, i]
            for p in range(3):
                b0, b1, b2 = wu * u[p], wv * v[p], wu * v[p] + wv * u[p]
                rows[a, 0, p], rows[a, 1, p], rows[a, 2, p] = b0, b1, b2
                stiff[a, 0, p] = area[i] * (c00 * b0 + c01 * b1 + c02 * b2)
                stiff[a, 1, p] = area[i] * (c01 * b0 + c11 * b1 + c12 * b2)
                stiff[a, 2, p] = area[i] * (c02 * b0 + c12 * b1 + c22 * b2)
        for a in range(3):
            along = area[i] * (stress[0, i] * hat[a, 0, i] + stress[2, i] * hat[a, 1, i])
            across = area[i] * (stress[2, i] * hat[a, 0, i] + stress[1, i] * hat[a, 1, i])
            for b in range(3):
                slot = slots[i, a, b]
                if slot < 0:
                    continue
                for p in range(3):
                    for q in range(3):
                        blocks[slot, p, q] += (
                            rows[a, 0, p] * stiff[b, 0, q]
                            + rows[a, 1, p] * stiff[b, 1, q]
                            + rows[a, 2, p] * stiff[b, 2, q]
                        )
                    blocks[slot, p, p] += along * hat[b, 0, i] + across * hat[b, 1, i]


@_compiled
def angles(x, index, found):
    """Write the dihedral angles of hinges to ``found`` (n,) [rad]."""
    for i in range(index.shape[0]):
        found[i] = _hinge(x, 0, index, i)[5]


@_compiled
def hinge(x, index, length, area, moment, stiffness, slots, blocks):
    """Add ``moment`` times the second derivative of each angle and ``stiffness`` times the square of its first."""
    slope, turned = np.empty((4, 3)), np.empty((4, 4, 3, 3))
    for i in range(index.shape[0]):
        edge, wing_c, wing_d, normal_c, normal_d, _ = _hinge(x, 0, index, i)
        square = max(_dot(edge, edge), (COLLAPSED * length[i]) ** 2)
        smallest = (COLLAPSED * area[i]) ** 2
        along_c, along_d = _dot(wing_c, edge) / square, _dot(wing_d, edge) / square
        at_c = -sqrt(square) / max(_dot(normal_c, normal_c), smallest)
        at_d = -sqrt(square) / max(_dot(normal_d, normal_d), smallest)
        for p in range(3):
            slope[2, p], slope[3, p] = at_c * normal_c[p], at_d * normal_d[p]
            slope[1, p] = -along_c * slope[2, p] - along_d * slope[3, p]
            slope[0, p] = (along_c - 1.0) * slope[2, p] + (along_d - 1.0) * slope[3, p]
        turned[:] = 0.0
        if moment[i] != 0.0:
            _second(turned, 2, edge, wing_c, square, smallest, along_c, slope, moment[i])
            _second(turned, 3, edge, wing_d, square, smallest, along_d, slope, moment[i])
            _balance(turned)
        for a in range(4):
            for b in range(4):
                slot = slots[i, a, b]
                if slot < 0:
                    continue
                for p in range(3):
                    for q in range(3):
                        blocks[slot, p, q] += turned[a, b, p, q] + stiffness[i] * slope[a, p] * slope[b, q]


@_compiled
def _second(turned, wing, edge, arm, square, smallest, along, slope, moment):
    """Add what one triangle of a hinge contributes to ``moment`` times the angle's second derivative.

    A wing's slope is g = -|e| N / |N|^2 with N = e x w, and the edge's ends have -t g and (t - 1) g with
    t = w.e / |e|^2; so all follows from dg/de and dg/dw, and translations change nothing. Where the triangle has
    collapsed nothing is added.
    """
    normal = _cross(edge, arm)
    area = _dot(normal, normal)
    if area <= smallest:
        return
    sign = moment if wing == 2 else -moment
    reach = sqrt(square)
    scale = sign * reach / area
    for q in range(3):
        unit = (1.0 if q == 0 else 0.0, 1.0 if q == 1 else 0.0, 1.0 if q == 2 else 0.0)
        by_edge, by_arm = _cross(unit, arm), _cross(edge, unit)  # dN
        twice_edge, twice_arm = 2.0 * _dot(normal, by_edge) / area, 2.0 * _dot(normal, by_arm) / area
        grown = edge[q] / square
        by_along = arm[q] / square - 2.0 * along * grown
        for p in range(3):
            on_edge = scale * (twice_edge * normal[p] - by_edge[p] - grown * normal[p])
            turned[wing, 1, p, q] += on_edge
            turned[1, wing, q, p] += on_edge
            turned[wing, wing, p, q] += scale * (twice_arm * normal[p] - by_arm[p])
            turned[1, 1, p, q] -= moment * slope[wing, p] * by_along + along * on_edge


@_compiled
def _balance(turned):
    """Fill in the edge's first end: a translation changes nothing."""
    for b in range(1, 4):
        for p in range(3):
            for q in range(3):
                turned[0, b, p, q] = -(turned[1, b, p, q] + turned[2, b, p, q] + turned[3, b, p, q])
                turned[b, 0, q, p] = turned[0, b, p, q]
    for p in range(3):
        for q in range(3):
            turned[0, 0, p, q] = -(turned[1, 0, p, q] + turned[2, 0, p, q] + turned[3, 0, p, q])
