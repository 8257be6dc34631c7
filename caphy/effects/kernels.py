"""Compiled loops over the elements of the effects that cost most, for the CPU.

Each adds one effect's energy and gradient, for many frames, to ``energy`` (T,) and ``gradient`` (T, V, 3), in one
pass and without temporaries; a frame's positions and gradient stay in the cache. The arithmetic is in double precision
whatever the arrays hold. Each kernel says the same as ``gradient`` of the effect it serves, which remains the
definition, serves every other device, and is what tests compare with.
"""

from __future__ import annotations

from functools import partial
from math import atan2, floor, pi, sqrt

from caphy.effects.hinge import COLLAPSED
from caphy.effects.strain_measured import LARGEST, SMOOTHING
from caphy.jit import compiled
from caphy.material.fabrics import BEND_SPACING, LOADED_TWICE, STRETCH_SAMPLED

_compiled = partial(
    compiled,
    nogil=True,
    fastmath={"contract", "reassoc", "arcp", "nsz"},
    error_model="numpy",
    boundscheck=False,
)
_inlined = partial(_compiled, forceinline=True)
"""What kernels call. Not inlined, it would be taken from where it was compiled alone by the process that compiles, and
from within its kernel by those that find that in the cache; each rounds otherwise, so results would depend on which."""


@_inlined()
def _vertex(x, t, a):
    return x[t, a, 0], x[t, a, 1], x[t, a, 2]


@_inlined()
def _minus(p, q):
    return p[0] - q[0], p[1] - q[1], p[2] - q[2]


@_inlined()
def _blend(a, p, b, q):
    return a * p[0] + b * q[0], a * p[1] + b * q[1], a * p[2] + b * q[2]


@_inlined()
def _dot(p, q):
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@_inlined()
def _cross(p, q):
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@_inlined()
def _add(gradient, t, a, p):
    gradient[t, a, 0] += p[0]
    gradient[t, a, 1] += p[1]
    gradient[t, a, 2] += p[2]


@_inlined()
def _deformation(x, t, index, hat, i):
    """Columns u, v of the deformation gradient and the Green strains uu, vv, uv of a face."""
    origin = _vertex(x, t, index[i, 0])
    b, c = _minus(_vertex(x, t, index[i, 1]), origin), _minus(_vertex(x, t, index[i, 2]), origin)
    u = _blend(hat[1, 0, i], b, hat[2, 0, i], c)
    v = _blend(hat[1, 1, i], b, hat[2, 1, i], c)
    return u, v, 0.5 * (_dot(u, u) - 1.0), 0.5 * (_dot(v, v) - 1.0), 0.5 * _dot(u, v)


@_inlined()
def _add_stress(gradient, t, index, hat, i, u, v, uu, vv, uv):
    """Add the forces of a face under a stress times its area."""
    bu, bv, cu, cv = hat[1, 0, i], hat[1, 1, i], hat[2, 0, i], hat[2, 1, i]
    b = _blend(uu * bu + uv * bv, u, uv * bu + vv * bv, v)
    c = _blend(uu * cu + uv * cv, u, uv * cu + vv * cv, v)
    _add(gradient, t, index[i, 0], _blend(-1.0, b, -1.0, c))
    _add(gradient, t, index[i, 1], b)
    _add(gradient, t, index[i, 2], c)


@_compiled()
def strain_stvk(x, index, hat, area, lame_lambda, lame_mu, energy, gradient):
    for t in range(x.shape[0]):
        total = 0.0
        for i in range(index.shape[0]):
            u, v, uu, vv, uv = _deformation(x, t, index, hat, i)
            pressure, twice = area[i] * lame_lambda * (uu + vv), 2.0 * area[i] * lame_mu
            suu, svv, suv = pressure + twice * uu, pressure + twice * vv, twice * uv
            total += 0.5 * (suu * uu + svv * vv) + suv * uv
            _add_stress(gradient, t, index, hat, i, u, v, suu, svv, suv)
        energy[t] += total


@_inlined()
def weights(strain):
    """The sampled rows' weight at a largest principal strain and its radial mean."""
    d = min(2.0 * strain / (sqrt(1.0 + 2.0 * strain) + 1.0), STRETCH_SAMPLED)
    within = d * (2.0 + d * (2.25 + 0.6 * d)) / (3.0 * STRETCH_SAMPLED * (1.0 + 0.5 * d) ** 2)
    beyond = LARGEST / max(strain, LARGEST)
    return d / STRETCH_SAMPLED, 1.0 - beyond * beyond * (1.0 - within)


@_inlined()
def flattened(stiffness, flat):
    """A stiffness led through zero without slope, its slope and its curvature."""
    t = abs(stiffness) / flat
    if t >= 1.0:
        return stiffness, 1.0, 0.0
    sign = 1.0 if stiffness > 0.0 else -1.0
    value = sign * flat * t * t * t * (6.0 - 8.0 * t + 3.0 * t * t)
    slope = t * t * (18.0 - 32.0 * t + 15.0 * t * t)
    return value, slope, sign * t * (36.0 - 96.0 * t + 60.0 * t * t) / flat


@_inlined()
def _mean_clamped(start, sampled, strain, weight, mean):
    """Radial mean of a clamped stiffness, its slope in ``sampled`` and its slope in ``strain``."""
    rise = sampled - start
    slope = 2.0 * (weight - mean) / strain if strain > 1e-12 else 2.0 / (3.0 * STRETCH_SAMPLED)
    whole, whole_slope = start + mean * rise, slope * rise
    if start * sampled < 0.0 and weight * (sampled - start) * sampled > -start * sampled:
        there = -start / rise * STRETCH_SAMPLED
        there *= 1.0 + 0.5 * there
        share = (there / strain) ** 2
        mean_there = share * weights(there)[1]
        before = share * start + mean_there * rise
        if start > 0.0:
            return before, mean_there, -2.0 * before / strain
        return whole - before, mean - mean_there, whole_slope + 2.0 * before / strain
    if start < 0.0 or (start == 0.0 and sampled < 0.0):
        return 0.0, 0.0, 0.0
    return whole, mean, whole_slope


@_inlined()
def _measured_stress(uu, vv, uv, start, directed):
    """Energy density and stress uu, vv, uv of a measured fabric; ``directed`` (6, 4) as in strain_measured."""
    half = 0.5 * (uu - vv)
    radius = sqrt(half * half + uv * uv + SMOOTHING**2)
    cosine = half / radius
    raw = max(0.5 * (uu + vv) + radius - SMOOTHING, 0.0)
    square = raw * raw + SMOOTHING**2
    strain, onset = raw**3 / square, raw * raw * (raw * raw + 3.0 * SMOOTHING**2) / (square * square)
    weight, mean = weights(strain)
    along = across = 0.0
    k0 = k1 = k2 = k3 = 0.0
    for column in range(4):
        c1, c2, c3, c4 = directed[1, column], directed[2, column], directed[3, column], directed[4, column]
        sampled = directed[0, column] + cosine * (c1 + cosine * (c2 + cosine * (c3 + cosine * c4)))
        turning = c1 + cosine * (2.0 * c2 + cosine * (3.0 * c3 + cosine * 4.0 * c4))
        sampled, flat, _ = flattened(sampled, directed[5, column])
        turning *= flat
        k, by_sampled, by_strain = _mean_clamped(start[column], sampled, strain, weight, mean)
        if column == 0:
            k0, part = k, uu * uu
        elif column == 1:
            k1, part = k, 2.0 * uu * vv
        elif column == 2:
            k2, part = k, vv * vv
        else:
            k3, part = k, 2.0 * uv * uv
        along += part * by_strain * onset
        across += part * by_sampled * turning
    half_cosine, turn = 0.5 * cosine, across * (1.0 - cosine * cosine) / (2.0 * radius)
    suu = 2.0 * (k0 * uu + k1 * vv) + along * (0.5 + half_cosine) + turn
    svv = 2.0 * (k1 * uu + k2 * vv) + along * (0.5 - half_cosine) - turn
    suv = 2.0 * k3 * uv + 0.5 * uv / radius * (along - across * cosine / radius)
    return k0 * uu * uu + 2.0 * (k1 * uu * vv + k3 * uv * uv) + k2 * vv * vv, suu, svv, suv


@_compiled()
def strain_measured(x, index, hat, area, start, directed, energy, gradient):
    for t in range(x.shape[0]):
        total = 0.0
        for i in range(index.shape[0]):
            u, v, uu, vv, uv = _deformation(x, t, index, hat, i)
            density, suu, svv, suv = _measured_stress(uu, vv, uv, start, directed)
            scale = 0.5 * LOADED_TWICE * area[i]
            total += scale * density
            _add_stress(gradient, t, index, hat, i, u, v, scale * suu, scale * svv, scale * suv)
        energy[t] += total


@_inlined()
def _hinge(x, t, index, i):
    """Edge, wings, normals of a hinge, and its angle."""
    a = _vertex(x, t, index[i, 0])
    edge = _minus(_vertex(x, t, index[i, 1]), a)
    wing_c, wing_d = _minus(_vertex(x, t, index[i, 2]), a), _minus(_vertex(x, t, index[i, 3]), a)
    normal_c, normal_d = _cross(edge, wing_c), _cross(wing_d, edge)
    angle = atan2(-sqrt(_dot(edge, edge)) * _dot(normal_c, wing_d), _dot(normal_c, normal_d))
    return edge, wing_c, wing_d, normal_c, normal_d, angle


@_inlined()
def _add_moment(gradient, t, index, i, edge, wing_c, wing_d, normal_c, normal_d, length, area, moment):
    """Add the forces of a hinge whose energy grows by ``moment`` per angle; as in hinge.dihedral_gradient."""
    square = _dot(edge, edge)
    smallest = (COLLAPSED * area) ** 2
    scale = -moment * sqrt(square)
    at_c = scale / max(_dot(normal_c, normal_c), smallest)
    at_d = scale / max(_dot(normal_d, normal_d), smallest)
    inverse = 1.0 / max(square, (COLLAPSED * length) ** 2)
    along_c, along_d = _dot(wing_c, edge) * inverse, _dot(wing_d, edge) * inverse
    _add(gradient, t, index[i, 0], _blend((along_c - 1.0) * at_c, normal_c, (along_d - 1.0) * at_d, normal_d))
    _add(gradient, t, index[i, 1], _blend(-along_c * at_c, normal_c, -along_d * at_d, normal_d))
    _add(gradient, t, index[i, 2], _blend(at_c, normal_c, 0.0, normal_c))
    _add(gradient, t, index[i, 3], _blend(at_d, normal_d, 0.0, normal_d))


@_inlined()
def _turn(angle, rest):
    """As in hinge.turn."""
    turned = angle - rest
    return turned - 2.0 * pi * floor(turned / (2.0 * pi) + 0.5)


@_compiled()
def bending(x, index, stiffness, rest_angle, length, area, energy, gradient):
    for t in range(x.shape[0]):
        total = 0.0
        for i in range(index.shape[0]):
            edge, wing_c, wing_d, normal_c, normal_d, angle = _hinge(x, t, index, i)
            turn = _turn(angle, rest_angle[i])
            total += stiffness[i] * turn * turn
            moment = 2.0 * stiffness[i] * turn
            _add_moment(gradient, t, index, i, edge, wing_c, wing_d, normal_c, normal_d, length[i], area[i], moment)
        energy[t] += total


@_inlined()
def angle_then(start, lagged, t, index, i, lead):
    """:meth:`caphy.effects.base.Elements.then` of a hinge's angle [rad]."""
    first = _hinge(start, t, index, i)[5]
    return first if lead == 0.0 else first + lead * _turn(_hinge(lagged, t, index, i)[5], first)


@_compiled()
def bending_damping(x, start, lagged, index, stiffness, length, area, lead, energy, gradient):
    """Bending whose rest angles are those of ``start`` (T, V, 3), led through those of ``lagged`` and beyond."""
    for t in range(x.shape[0]):
        total = 0.0
        for i in range(index.shape[0]):
            before = angle_then(start, lagged, t, index, i, lead)
            edge, wing_c, wing_d, normal_c, normal_d, angle = _hinge(x, t, index, i)
            turn = _turn(angle, before)
            total += stiffness[i] * turn * turn
            moment = 2.0 * stiffness[i] * turn
            _add_moment(gradient, t, index, i, edge, wing_c, wing_d, normal_c, normal_d, length[i], area[i], moment)
        energy[t] += total


@_compiled()
def bending_measured(x, index, nodes, rest_angle, length, area, energy, gradient):
    for t in range(x.shape[0]):
        total = 0.0
        for i in range(index.shape[0]):
            edge, wing_c, wing_d, normal_c, normal_d, angle = _hinge(x, t, index, i)
            turn = _turn(angle, rest_angle[i])
            scale = length[i] / (2.0 * area[i])
            column = abs(turn) * scale / BEND_SPACING
            k, integral, rise = nodes[0, i], 0.5 * nodes[0, i] * column * column, 0.0
            for place in range(5):
                if column <= place:
                    break
                following = nodes[place + 1, i] - nodes[place, i] if place < 4 else 0.0
                bend, rise, beyond = following - rise, following, column - place
                k += bend * beyond
                integral += bend * beyond * beyond * (beyond / 3.0 + 0.5 * place)
            total += BEND_SPACING**2 * area[i] * integral
            moment = k * scale * scale * area[i] * turn
            _add_moment(gradient, t, index, i, edge, wing_c, wing_d, normal_c, normal_d, length[i], area[i], moment)
        energy[t] += total


@_compiled()
def spring(x, anchor, index, stiffness, energy, gradient):
    """Vertex springs of a stiffness [N/m] to where ``anchor`` (T, V, 3) has each vertex."""
    for t in range(x.shape[0]):
        total = 0.0
        for i in range(index.shape[0]):
            a = index[i, 0]
            offset = _minus(_vertex(x, t, a), _vertex(anchor, t, a))
            total += 0.5 * stiffness[i] * _dot(offset, offset)
            _add(gradient, t, a, _blend(stiffness[i], offset, 0.0, offset))
        energy[t] += total


@_compiled()
def gravity(x, index, mass, acceleration, energy, gradient):
    for t in range(x.shape[0]):
        total = 0.0
        for i in range(index.shape[0]):
            for axis in range(3):
                force = mass[i] * acceleration[axis]
                total -= force * x[t, index[i, 0], axis]
                gradient[t, index[i, 0], axis] -= force
        energy[t] += total


@_compiled()
def body_contact(x, point, normal, index, area, layer, stiffness, distance, energy, gradient):
    for t in range(x.shape[0]):
        total = 0.0
        for i in range(index.shape[0]):
            a = index[i, 0]
            away = _vertex(normal, t, a)
            depth = distance + layer[i] - _dot(away, _minus(_vertex(x, t, a), _vertex(point, t, a)))
            if not depth <= 0.0:  # NaN is passed on
                shallow = min(depth, distance + layer[i])  # inside the body the push is that at the skin
                push = stiffness * area[i] * shallow * shallow
                total += push * (3.0 * depth - 2.0 * shallow)
                _add(gradient, t, a, _blend(-3.0 * push, away, 0.0, away))
        energy[t] += total


@_inlined()
def unit_normal(x, t, index, i):
    """As area_vector of effects.air, scaled to one; zero without area."""
    origin = _vertex(x, t, index[i, 0])
    across = _cross(_minus(_vertex(x, t, index[i, 1]), origin), _minus(_vertex(x, t, index[i, 2]), origin))
    return _blend(1.0 / max(sqrt(_dot(across, across)), 1e-12), across, 0.0, across)


@_inlined()
def velocity_of_face(x, origin, t, index, i, dt):
    """Mean velocity of a face's corners."""
    total = _minus(_vertex(x, t, index[i, 0]), _vertex(origin, t, index[i, 0]))
    for k in range(1, 3):
        moved = _minus(_vertex(x, t, index[i, k]), _vertex(origin, t, index[i, k]))
        total = _blend(1.0, total, 1.0, moved)
    return _blend(1.0 / (3.0 * dt), total, 0.0, total)


@_inlined()
def projected(field, normal, across):
    """The part of a vector across a face, or along it."""
    part = _blend(_dot(field, normal), normal, 0.0, normal)
    return part if across else _minus(field, part)


@_compiled()
def air(x, origin, lagged, index, area, dt, across, power, drag, wind, push, energy, gradient):
    blown, pushed = (wind[0], wind[1], wind[2]), (push[0], push[1], push[2])
    for t in range(x.shape[0]):
        total = 0.0
        for i in range(index.shape[0]):
            normal, velocity = unit_normal(lagged, t, index, i), velocity_of_face(x, origin, t, index, i, dt)
            density, force = 0.0, (0.0, 0.0, 0.0)
            if power > 0:
                slip = projected(_minus(velocity, blown), normal, across)
                speed = max(sqrt(_dot(slip, slip)), 1e-12)
                growth = drag * (speed if power == 2 else 1.0)
                density, force = growth * speed * speed / (power + 1.0), _blend(growth, slip, 0.0, slip)
            density -= _dot(pushed, projected(velocity, normal, across))
            force = _minus(force, projected(pushed, normal, across))
            total += dt * area[i] * density
            share = _blend(area[i] / 3.0, force, 0.0, force)
            for k in range(3):
                _add(gradient, t, index[i, k], share)
        energy[t] += total
