"""Stress and tangent of the measured fabrics in a compiled loop: what the solver asks for in every iteration.

The density in :mod:`caphy.effects.strain_measured` remains the definition. Torch can differentiate that twice, which
takes forty times as long; here the derivatives are written out, and tests compare the two.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from caphy.effects.kernels import _compiled, _inlined, flattened, weights
from caphy.effects.strain_measured import SMOOTHING
from caphy.material.fabrics import LOADED_TWICE, STRETCH_SAMPLED

_SMALL = 1e-6  # strain below which the mean weight's slopes are those of its series at zero


@_inlined()
def _mean_weight_slopes(strain, weight, mean):
    """First and second slope of the radial mean of the sampled rows' weight."""
    if strain < _SMALL:
        return (2.0 / 3.0 - 0.5 * strain) / STRETCH_SAMPLED, (1.2 * strain - 0.5) / STRETCH_SAMPLED
    first = 2.0 * (weight - mean) / strain
    onward = 1.0 / (sqrt(1.0 + 2.0 * strain) * STRETCH_SAMPLED) if weight < 1.0 else 0.0
    return first, (2.0 * (onward - first) - first) / strain


@_inlined()
def _mean_clamped(start, sampled, strain, weight, mean, first, second):
    """Radial mean K of a clamped stiffness and its slopes: s, g, ss, sg, gg in ``sampled`` s and ``strain`` g."""
    rise = sampled - start
    whole = (start + mean * rise, mean, first * rise, 0.0, first, second * rise)
    if start * sampled < 0.0 and weight * rise * sampled > -start * sampled:
        d = -start / rise * STRETCH_SAMPLED
        there = d * (1.0 + 0.5 * d)
        there_slope = (1.0 + d) * STRETCH_SAMPLED * start / (rise * rise)
        weight_there, mean_there = weights(there)
        inverse = 1.0 / (strain * strain)
        s = there * there * inverse * mean_there
        k = there * there * inverse * start + s * rise
        ss = 2.0 * there * weight_there * there_slope * inverse
        g, sg, gg = -2.0 * k / strain, -2.0 * s / strain, 6.0 * k * inverse
        if start > 0.0:
            return k, s, g, ss, sg, gg
        return whole[0] - k, whole[1] - s, whole[2] - g, whole[3] - ss, whole[4] - sg, whole[5] - gg
    if start < 0.0 or (start == 0.0 and sampled < 0.0):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    return whole


@_inlined()
def _quadratic(column, uu, vv, uv, part, parts):
    """What one of the four stiffnesses multiplies in twice the energy density, its slopes and its second slopes."""
    part[:] = 0.0
    parts[:] = 0.0
    if column == 0:
        part[0], parts[0, 0] = 2.0 * uu, 2.0
        return uu * uu
    if column == 1:
        part[0], part[1], parts[0, 1], parts[1, 0] = 2.0 * vv, 2.0 * uu, 2.0, 2.0
        return 2.0 * uu * vv
    if column == 2:
        part[1], parts[1, 1] = 2.0 * vv, 2.0
        return vv * vv
    part[2], parts[2, 2] = 4.0 * uv, 4.0
    return 2.0 * uv * uv


@_compiled()
def measured_response(uu, vv, uv, start, directed, found):
    """Stress and tangent in d / d(uu, vv, 2 uv) of Green strains (n,): uu, vv, uv and 00, 11, 22, 01, 02, 12.

    ``start`` (4,) and ``directed`` (6, 4) are as in strain_measured [N/m]; ``found`` (9, n) [N/m] is filled.
    """
    first, second = np.zeros(3), np.zeros((3, 3))
    c, cc, g, gg = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
    part, parts = np.zeros(3), np.zeros((3, 3))
    for n in range(len(uu)):
        a, b, w = uu[n], vv[n], uv[n]
        half = 0.5 * (a - b)
        radius = sqrt(half * half + w * w + SMOOTHING**2)
        cosine, sine, inverse = half / radius, w / radius, 1.0 / radius
        # the cosine, by the strains; it depends on uu and vv through half their difference alone
        by_half = (1.0 - cosine * cosine) * inverse
        c[0], c[1], c[2] = 0.5 * by_half, -0.5 * by_half, -cosine * sine * inverse
        _second(cc, -3.0 * cosine * by_half * inverse, sine * (3.0 * cosine * cosine - 1.0) * inverse * inverse,
                cosine * (3.0 * sine * sine - 1.0) * inverse * inverse)  # fmt: skip
        # the largest principal strain, its corner at zero rounded
        raw = max(0.5 * (a + b) + radius - SMOOTHING, 0.0)
        square = raw * raw + SMOOTHING**2
        strain = raw * raw * raw / square
        onset = raw * raw * (raw * raw + 3.0 * SMOOTHING**2) / (square * square)
        bend = 2.0 * SMOOTHING**2 * raw * (3.0 * SMOOTHING**2 - raw * raw) / (square * square * square)
        g[0], g[1], g[2] = 0.5 + 0.5 * cosine, 0.5 - 0.5 * cosine, sine
        _second(gg, by_half, -cosine * sine * inverse, (1.0 - sine * sine) * inverse)
        for i in range(3):
            for j in range(3):
                gg[i, j] = onset * gg[i, j] + bend * g[i] * g[j]
        for i in range(3):
            g[i] *= onset
        weight, mean = weights(strain)
        slope, curve = _mean_weight_slopes(strain, weight, mean)
        first[:] = 0.0
        second[:] = 0.0
        for column in range(4):
            c1, c2, c3, c4 = directed[1, column], directed[2, column], directed[3, column], directed[4, column]
            sampled = directed[0, column] + cosine * (c1 + cosine * (c2 + cosine * (c3 + cosine * c4)))
            turning = c1 + cosine * (2.0 * c2 + cosine * (3.0 * c3 + cosine * 4.0 * c4))
            twisting = 2.0 * c2 + cosine * (6.0 * c3 + cosine * 12.0 * c4)
            sampled, flat, bent = flattened(sampled, directed[5, column])
            turning, twisting = flat * turning, flat * twisting + bent * turning * turning
            k, by_s, by_g, by_ss, by_sg, by_gg = _mean_clamped(
                start[column], sampled, strain, weight, mean, slope, curve
            )
            whole = _quadratic(column, a, b, w, part, parts)
            for i in range(3):
                ki = by_s * turning * c[i] + by_g * g[i]
                first[i] += part[i] * k + whole * ki
                for j in range(i, 3):
                    kj = by_s * turning * c[j] + by_g * g[j]
                    kij = (by_s * twisting + by_ss * turning * turning) * c[i] * c[j] + by_s * turning * cc[i, j]
                    kij += by_g * gg[i, j] + by_gg * g[i] * g[j] + by_sg * turning * (c[i] * g[j] + c[j] * g[i])
                    second[i, j] += parts[i, j] * k + part[i] * kj + part[j] * ki + whole * kij
        scale = 0.5 * LOADED_TWICE
        found[0, n], found[1, n], found[2, n] = scale * first[0], scale * first[1], 0.5 * scale * first[2]
        found[3, n], found[4, n], found[5, n] = scale * second[0, 0], scale * second[1, 1], 0.25 * scale * second[2, 2]
        found[6, n] = scale * second[0, 1]
        found[7, n], found[8, n] = 0.5 * scale * second[0, 2], 0.5 * scale * second[1, 2]


@_inlined()
def _second(into, by_half_half, by_half_shear, by_shear_shear):
    """Second slopes in uu, vv, uv from those in half the difference (uu - vv) / 2 and the shear uv."""
    into[0, 0] = into[1, 1] = 0.25 * by_half_half
    into[0, 1] = into[1, 0] = -0.25 * by_half_half
    into[0, 2] = into[2, 0] = 0.5 * by_half_shear
    into[1, 2] = into[2, 1] = -0.5 * by_half_shear
    into[2, 2] = by_shear_shear
