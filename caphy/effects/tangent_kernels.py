"""The positive part of membranes' tangents in a compiled loop: what a solver asks for in every iteration.

LAPACK, called for each of thousands of 3x3 matrices, takes ten times as long.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from caphy.effects.kernels import _compiled, _inlined

_SWEEPS = 12  # Jacobi's method squares what is left in each; five are enough
_NONE = 1e-36  # squared share of the whole in what is left beside the diagonal at which it ends


@_inlined()
def _turned(m, v, p, q, r):
    """One Jacobi rotation of a symmetric 3x3 matrix in the plane of axes p and q, and of its eigenvectors."""
    beside = m[p, q]
    if beside == 0.0:
        return
    ratio = (m[q, q] - m[p, p]) / (2.0 * beside)
    tangent = 1.0 / (abs(ratio) + sqrt(ratio * ratio + 1.0))
    if ratio < 0.0:
        tangent = -tangent
    c = 1.0 / sqrt(tangent * tangent + 1.0)
    s = tangent * c
    m[p, p] -= tangent * beside
    m[q, q] += tangent * beside
    m[p, q] = m[q, p] = 0.0
    m[p, r], m[q, r] = c * m[p, r] - s * m[q, r], s * m[p, r] + c * m[q, r]
    m[r, p], m[r, q] = m[p, r], m[q, r]
    for i in range(3):
        v[i, p], v[i, q] = c * v[i, p] - s * v[i, q], s * v[i, p] + c * v[i, q]


@_compiled()
def positive_tangents(tangents, found):
    """Symmetric 3x3 matrices without their negative eigenvalues, by their entries 00, 11, 22, 01, 02, 12 (6, n)."""
    m, v = np.empty((3, 3)), np.empty((3, 3))
    for n in range(tangents.shape[1]):
        a, b, c = tangents[0, n], tangents[1, n], tangents[2, n]
        d, e, f = tangents[3, n], tangents[4, n], tangents[5, n]
        for k in range(6):
            found[k, n] = tangents[k, n]
        minor = a * b - d * d
        if a > 0.0 and minor > 0.0 and minor * c + 2.0 * d * e * f - a * f * f - b * e * e > 0.0:
            continue  # it has none
        m[0, 0], m[1, 1], m[2, 2] = a, b, c
        m[0, 1] = m[1, 0] = d
        m[0, 2] = m[2, 0] = e
        m[1, 2] = m[2, 1] = f
        v[:] = 0.0
        v[0, 0] = v[1, 1] = v[2, 2] = 1.0
        whole = a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)
        for _ in range(_SWEEPS):
            if m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2] + m[1, 2] * m[1, 2] <= _NONE * whole:
                break
            _turned(m, v, 0, 1, 2)
            _turned(m, v, 0, 2, 1)
            _turned(m, v, 1, 2, 0)
        for k in range(3):
            low = m[k, k]
            if low < 0.0:
                found[0, n] -= low * v[0, k] * v[0, k]
                found[1, n] -= low * v[1, k] * v[1, k]
                found[2, n] -= low * v[2, k] * v[2, k]
                found[3, n] -= low * v[0, k] * v[1, k]
                found[4, n] -= low * v[0, k] * v[2, k]
                found[5, n] -= low * v[1, k] * v[2, k]
