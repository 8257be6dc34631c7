"""What changes of a step's past do to the forces of the effects that cost most, compiled, for tangents of roll-outs."""

from __future__ import annotations

import numpy as np

from caphy.effects.kernels import _add_moment, _compiled, _hinge, _inlined


@_inlined()
def _slope(x, index, i, length, area, factor, corners, slopes):
    """Add a hinge's gradient of the angle times a factor to its corners in ``slopes`` (n, 4, 3)."""
    edge, wing_c, wing_d, normal_c, normal_d, _ = _hinge(x, 0, index, i)
    _add_moment(slopes, i, corners, 0, edge, wing_c, wing_d, normal_c, normal_d, length[i], area[i], factor)


@_compiled()
def bending_damping(x, start, lagged, index, stiffness, length, area, lead, by_start, by_lagged, total):
    """Add to ``total`` (K, V, 3) what K changes (K, V, 3) of where a step began, and of where the one before ended, do
    to the gradient of bending damping; the rest is as in :func:`caphy.effects.kernels.bending_damping`.

    The moment is 2 s (theta - (1 - lead) theta_start - lead theta_lagged), and changes along the gradients of the two.
    """
    many, corners = index.shape[0], np.arange(4).reshape(1, 4)
    here, first, last = np.zeros((many, 4, 3)), np.zeros((many, 4, 3)), np.zeros((many, 4, 3))
    for i in range(many):
        _slope(x, index, i, length, area, -2.0 * stiffness[i], corners, here)
        _slope(start, index, i, length, area, 1.0 - lead, corners, first)
        if lead != 0.0:
            _slope(lagged, index, i, length, area, lead, corners, last)
    for k in range(by_start.shape[0]):
        for i in range(many):
            turn = 0.0
            for corner in range(4):
                a = index[i, corner]
                for axis in range(3):
                    turn += (
                        first[i, corner, axis] * by_start[k, a, axis] + last[i, corner, axis] * by_lagged[k, a, axis]
                    )
            for corner in range(4):
                a = index[i, corner]
                for axis in range(3):
                    total[k, a, axis] += turn * here[i, corner, axis]
