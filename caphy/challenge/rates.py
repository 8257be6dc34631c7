"""Short steps and internal damping from velocities, compiled: they come far too often for anything slower.

The effects state damping by the change over a step; these are the same laws in the limit of no step at all, written
in the rates of angle and strain themselves.
"""

from __future__ import annotations

from functools import partial
from math import sqrt

import numpy as np

from caphy.jit import compiled

COLLAPSED = 1e-13
"""Four times the squared area [m^4] below which a triangle counts as collapsed: a thousandth of the usual area."""

FAR = 1e6
"""Metres beyond which no cloth is. (``isfinite`` is always true under ``reassoc``, which takes x - x for zero.)"""

_compiled = partial(compiled, nogil=True, fastmath={"contract", "reassoc", "arcp", "nsz"}, error_model="numpy")
_inlined = partial(_compiled, forceinline=True)
"""As in :mod:`caphy.effects.kernels`: the same numbers, whether compiled just now or found in the cache."""


@_compiled()
def drift(x, v, force, inverse, kick, dt):
    """Velocities v (V, 3) after a force over a time ``kick`` [s], and positions x (V, 3) a time dt [s] later; tells
    whether all are numbers, and nearer than :data:`FAR`."""
    near = True
    for a in range(len(x)):
        for k in range(3):
            v[a, k] += kick * inverse[a, 0] * force[a, k]
            x[a, k] += dt * v[a, k]
            near &= abs(x[a, k]) < FAR
    return near


@_compiled()
def bending_rates(x, v, hinges, viscosity, slope):
    """Add 2 c_i dtheta/dt grad(theta) of hinges (n, 4) with viscosities c_i (n,) [J s] to ``slope`` (V, 3)."""
    for i in range(len(hinges)):
        a, b, c, d = hinges[i, 0], hinges[i, 1], hinges[i, 2], hinges[i, 3]
        edge, wing_c, wing_d = _between(x, a, b), _between(x, a, c), _between(x, a, d)
        normal_c, normal_d = _cross(edge, wing_c), _cross(wing_d, edge)
        square = _dot(edge, edge)
        length = sqrt(square)
        at_c = _times(-length / max(_dot(normal_c, normal_c), COLLAPSED), normal_c)
        at_d = _times(-length / max(_dot(normal_d, normal_d), COLLAPSED), normal_d)
        share_c, share_d = _dot(wing_c, edge) / square, _dot(wing_d, edge) / square
        at_a = _blend(share_c - 1.0, at_c, share_d - 1.0, at_d)
        at_b = _blend(-share_c, at_c, -share_d, at_d)
        rate = _along(v, a, at_a) + _along(v, b, at_b) + _along(v, c, at_c) + _along(v, d, at_d)
        moment = 2.0 * viscosity[i] * rate
        _add(slope, a, moment, at_a)
        _add(slope, b, moment, at_b)
        _add(slope, c, moment, at_c)
        _add(slope, d, moment, at_d)


@_inlined()
def strain_rates(x, v, faces, inverse, viscosity, slope):
    """Add the slope of the stress eta dG/dt of faces (n, 3) with eta A (n,) [N m s] to ``slope`` (V, 3).

    ``inverse`` (n, 2, 2) [1/m] is that of each face's rest edge matrix.
    """
    for i in range(len(faces)):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        p, q, r, s = inverse[i, 0, 0], inverse[i, 0, 1], inverse[i, 1, 0], inverse[i, 1, 1]
        ab, ac, vb, vc = _between(x, a, b), _between(x, a, c), _between(v, a, b), _between(v, a, c)
        u, w = _blend(p, ab, r, ac), _blend(q, ab, s, ac)
        du, dw = _blend(p, vb, r, vc), _blend(q, vb, s, vc)
        uu, ww, uw = _dot(u, du), _dot(w, dw), 0.5 * (_dot(u, dw) + _dot(w, du))
        along_u, along_w = _blend(uu, u, uw, w), _blend(uw, u, ww, w)
        at_b, at_c = _blend(p, along_u, q, along_w), _blend(r, along_u, s, along_w)
        _add(slope, a, -viscosity[i], _blend(1.0, at_b, 1.0, at_c))
        _add(slope, b, viscosity[i], at_b)
        _add(slope, c, viscosity[i], at_c)


@_compiled()
def slowed(x, v, faces, inverse, viscosity, mass):
    """Velocities w (V, 3) with m (w - v) = -:func:`strain_rates` of w; ``viscosity`` (n,) times the time [N m s^2].

    Conjugate gradients; vertices of infinite mass keep their velocity.
    """
    w, residual, direction = v.copy(), np.zeros_like(v), np.zeros_like(v)
    lightness = np.zeros_like(v)
    for a in range(len(v)):
        lightness[a, :] = 1.0 / mass[a]
    strain_rates(x, w, faces, inverse, viscosity, residual)
    residual = -residual
    enough, last = 1e-16 * np.sum(v * v * np.where(lightness > 0, 1 / lightness, 0.0)), 1.0
    for _ in range(200):
        square = np.sum(residual * residual * lightness)
        if square <= enough:
            break
        direction = lightness * residual + square / last * direction
        slope = np.zeros_like(v)
        strain_rates(x, direction, faces, inverse, viscosity, slope)
        slope += np.where(lightness > 0, direction / lightness, 0.0)
        step = square / np.sum(direction * slope)
        w, residual, last = w + step * direction, residual - step * slope, square
    return w


@_inlined()
def _between(x, a, b):
    return x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]


@_inlined()
def _blend(a, p, b, q):
    return a * p[0] + b * q[0], a * p[1] + b * q[1], a * p[2] + b * q[2]


@_inlined()
def _times(a, p):
    return a * p[0], a * p[1], a * p[2]


@_inlined()
def _dot(p, q):
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@_inlined()
def _cross(p, q):
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@_inlined()
def _along(v, a, p):
    return v[a, 0] * p[0] + v[a, 1] * p[1] + v[a, 2] * p[2]


@_inlined()
def _add(slope, a, factor, p):
    slope[a, 0] += factor * p[0]
    slope[a, 1] += factor * p[1]
    slope[a, 2] += factor * p[2]
