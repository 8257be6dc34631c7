"""What changes of a step's past do to the forces of the effects that cost most, compiled, for tangents of roll-outs."""

from __future__ import annotations

from math import sqrt

import numpy as np

from caphy.effects.hinge import COLLAPSED
from caphy.effects.kernels import _blend, _compiled, _dot, _hinge, _inlined


@_inlined()
def _slope(x, index, i, length, area):
    """Gradient of a hinge's angle, corner by corner; as :func:`caphy.effects.hinge.dihedral_gradient`."""
    edge, wing_c, wing_d, normal_c, normal_d, _ = _hinge(x, 0, index, i)
    square = _dot(edge, edge)
    smallest = (COLLAPSED * area) ** 2
    at_c = -sqrt(square) / max(_dot(normal_c, normal_c), smallest)
    at_d = -sqrt(square) / max(_dot(normal_d, normal_d), smallest)
    inverse = 1.0 / max(square, (COLLAPSED * length) ** 2)
    along_c, along_d = _dot(wing_c, edge) * inverse, _dot(wing_d, edge) * inverse
    return (
        _blend((along_c - 1.0) * at_c, normal_c, (along_d - 1.0) * at_d, normal_d),
        _blend(-along_c * at_c, normal_c, -along_d * at_d, normal_d),
        _blend(at_c, normal_c, 0.0, normal_c),
        _blend(at_d, normal_d, 0.0, normal_d),
    )


@_inlined()
def _put(slopes, i, factor, slope):
    for corner in range(4):
        for axis in range(3):
            slopes[i, 3 * corner + axis] = factor * slope[corner][axis]


@_compiled()
def bending_damping(x, start, lagged, index, stiffness, length, area, lead, by_start, by_lagged, total):
    """Add to ``total`` (K, V, 3) what K changes (K, V, 3) of where a step began, and of where the one before ended, do
    to the gradient of bending damping; the rest is as in :func:`caphy.effects.kernels.bending_damping`.

    The moment is 2 s (theta - (1 - lead) theta_start - lead theta_lagged), and changes along the gradients of the two.
    """
    many = index.shape[0]
    here, first, last = np.empty((many, 12)), np.empty((many, 12)), np.empty((many, 12))
    for i in range(many):
        _put(here, i, -2.0 * stiffness[i], _slope(x, index, i, length[i], area[i]))
        _put(first, i, 1.0 - lead, _slope(start, index, i, length[i], area[i]))
        if lead != 0.0:
            _put(last, i, lead, _slope(lagged, index, i, length[i], area[i]))
    for k in range(by_start.shape[0]):
        for i in range(many):
            turn = 0.0
            for corner in range(4):
                a = index[i, corner]
                for axis in range(3):
                    turn += first[i, 3 * corner + axis] * by_start[k, a, axis]
                    if lead != 0.0:
                        turn += last[i, 3 * corner + axis] * by_lagged[k, a, axis]
            for corner in range(4):
                a = index[i, corner]
                for axis in range(3):
                    total[k, a, axis] += here[i, 3 * corner + axis] * turn
