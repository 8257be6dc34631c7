"""Rotations as axis-angle, matrix, quaternion (w first) and 6D, for numpy arrays and torch tensors alike.

Every function takes arrays with any leading axes and answers in the namespace and dtype it was given.
"""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace

Array = Any
"""A numpy array or a torch tensor."""


def matrix_from_axis_angle(axis_angle: Array) -> Array:
    """Rotation matrices (..., 3, 3) of axis-angle vectors (..., 3) [rad], by Rodrigues' formula.

    Exact at zero and smooth around it: sin(a)/a and (1-cos a)/a^2 are written through sinc-like quotients that
    stay finite, so gradients are finite as well.
    """
    xp = array_namespace(axis_angle)
    x, y, z = axis_angle[..., 0], axis_angle[..., 1], axis_angle[..., 2]
    square = x * x + y * y + z * z
    small = square < 1e-8  # below it the series is exact to rounding even in float32
    safe = xp.where(small, xp.ones_like(square), square)
    angle = xp.sqrt(safe)
    sine = xp.where(small, 1 - square / 6, xp.sin(angle) / angle)
    half = xp.sin(angle / 2)
    versine = xp.where(small, 0.5 - square / 24, 2 * half * half / safe)
    one = 1 - versine * square
    entries = [
        [one + versine * x * x, versine * x * y - sine * z, versine * x * z + sine * y],
        [versine * x * y + sine * z, one + versine * y * y, versine * y * z - sine * x],
        [versine * x * z - sine * y, versine * y * z + sine * x, one + versine * z * z],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in entries], axis=-2)


def quaternion_from_axis_angle(axis_angle: Array) -> Array:
    """Unit quaternions (..., 4), w first, of axis-angle vectors (..., 3) [rad]."""
    xp = array_namespace(axis_angle)
    square = xp.sum(axis_angle * axis_angle, axis=-1, keepdims=True)
    small = square < 1e-8
    angle = xp.sqrt(xp.where(small, xp.ones_like(square), square))
    scale = xp.where(small, 0.5 - square / 48, xp.sin(angle / 2) / angle)
    real = xp.where(small, 1 - square / 8, xp.cos(angle / 2))
    return xp.concat([real, scale * axis_angle], axis=-1)


def axis_angle_from_quaternion(quaternion: Array) -> Array:
    """Axis-angle vectors (..., 3) [rad], angle in [0, pi], of unit quaternions (..., 4), w first."""
    xp = array_namespace(quaternion)
    quaternion = xp.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    vector = quaternion[..., 1:]
    norm = xp.sqrt(xp.sum(vector * vector, axis=-1, keepdims=True))
    small = norm < 1e-8
    safe = xp.where(small, xp.ones_like(norm), norm)
    angle = 2 * xp.atan2(norm, quaternion[..., :1])
    return vector * xp.where(small, 2 * xp.ones_like(norm), angle / safe)


def quaternion_from_matrix(matrix: Array) -> Array:
    """Unit quaternions (..., 4), w first, of rotation matrices (..., 3, 3).

    Of the four equivalent formulas the one with the largest divisor is taken per matrix (Shepperd 1978), so it is
    accurate near half turns too.
    """
    xp = array_namespace(matrix)
    m = [[matrix[..., i, j] for j in range(3)] for i in range(3)]
    trace = m[0][0] + m[1][1] + m[2][2]
    candidates = xp.stack(
        [
            xp.stack([1 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]], axis=-1),
            xp.stack([m[2][1] - m[1][2], 1 + 2 * m[0][0] - trace, m[0][1] + m[1][0], m[0][2] + m[2][0]], axis=-1),
            xp.stack([m[0][2] - m[2][0], m[0][1] + m[1][0], 1 + 2 * m[1][1] - trace, m[1][2] + m[2][1]], axis=-1),
            xp.stack([m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 1 + 2 * m[2][2] - trace], axis=-1),
        ],
        axis=-2,
    )
    divisors = xp.stack([candidates[..., i, i] for i in range(4)], axis=-1)
    best = xp.argmax(divisors, axis=-1)
    chosen = xp.zeros_like(candidates[..., 0, :])
    for i in range(4):
        chosen = xp.where((best == i)[..., None], candidates[..., i, :], chosen)
    return chosen / xp.sqrt(xp.sum(chosen * chosen, axis=-1, keepdims=True))


def axis_angle_from_matrix(matrix: Array) -> Array:
    """Axis-angle vectors (..., 3) [rad], angle in [0, pi], of rotation matrices (..., 3, 3)."""
    return axis_angle_from_quaternion(quaternion_from_matrix(matrix))


def slerp(start: Array, end: Array, fraction: Array) -> Array:
    """Quaternions (..., 4) on the shorter great arc from ``start`` to ``end``, both (..., 4).

    ``fraction`` broadcasts against the leading axes (Shoemake, SIGGRAPH 1985).
    """
    xp = array_namespace(start, end)
    cosine = xp.sum(start * end, axis=-1, keepdims=True)
    end = xp.where(cosine < 0, -end, end)
    cosine = xp.clip(xp.abs(cosine), None, 1.0)
    fraction = fraction[..., None]
    close = cosine > 1 - 1e-10
    angle = xp.acos(xp.where(close, xp.zeros_like(cosine), cosine))
    sine = xp.sin(angle)
    left = xp.where(close, 1 - fraction, xp.sin((1 - fraction) * angle) / sine)
    right = xp.where(close, fraction, xp.sin(fraction * angle) / sine)
    mixed = left * start + right * end
    return mixed / xp.sqrt(xp.sum(mixed * mixed, axis=-1, keepdims=True))


def sixd_from_matrix(matrix: Array) -> Array:
    """The first two columns (..., 6) of rotation matrices (..., 3, 3): continuous (Zhou et al., CVPR 2019)."""
    xp = array_namespace(matrix)
    return xp.concat([matrix[..., :, 0], matrix[..., :, 1]], axis=-1)
