"""In-plane elasticity of the measured fabrics."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import Membrane, Symmetric, Tangent
from caphy.material.fabrics import LOADED_TWICE, STRETCH_SAMPLED, fabric

SMOOTHING = 0.003
"""Green strain over which the kinks of the published interpolation are rounded: below what was measured."""

FLATTENED = 0.1
"""Of its five directions' root mean square: where a stiffness at 16.7 % stretch is led smoothly through zero."""

LARGEST = ((1 + STRETCH_SAMPLED) ** 2 - 1) / 2
"""Principal Green strain of the rows at 16.7 % stretch."""

_NODES = np.cos(np.arange(5) * np.pi / 4)
_POLYNOMIAL = np.linalg.inv(np.vander(_NODES, increasing=True))
"""Coefficients (5, 5) of the polynomial in cos(2 angle) through values at 0, 22.5, 45, 67.5 and 90 degrees."""


class StrainMeasured(Membrane):
    """Orthotropic membrane with measured stiffness, E = A/2 (K0 Guu^2 + 2 K1 Guu Gvv + K2 Gvv^2 + 2 K3 Guv^2) [J].

    The measurement is a stress, S = k(G) G, with k linear in the largest principal stretch between a table's row near
    zero strain and those at 16.7 %, linear in that stretch's direction between these, and never negative. With k
    depending on strain that is not the gradient of 1/2 G k(G) G, and of no other energy either. Frozen k (as ARCSim
    has it) would give a force without energy, on which no line search and no loss can stand. So the energy is the
    measured work along straight loading from rest to G,

        E = A int_0^1 S(tau G) : G dtau,      i.e.     K = 2 int_0^1 tau k(tau G) dtau,

    a true function of G whose stress agrees with the measured one along the loading (S : G, all that a tensile test
    measures). The direction enters through the polynomial in cos(2 angle) that meets the five measured directions,
    which is even and periodic as orthotropy demands; near equal biaxial stretch, where no direction exists, it turns
    to the value at 45 degrees. The corners of the published interpolation are rounded over 0.3 % strain, and where
    beyond the rows at 16.7 % a stiffness falls below zero with the direction, and is none from there, over a tenth of
    what it usually is, so that stress is continuous. The default is a knit, gray interlock.
    """

    name = "strain_measured"
    group = "stiffness"
    parameters = {
        "stretching": Parameter(
            tuple(map(tuple, fabric("gray-interlock").stretching.tolist())),
            "N/m",
            -1e4,
            1e4,
            linear=False,
            doc="stretching table: C_uuuu, C_uuvv, C_vvvv, C_uv near zero strain and at 16.7 % in five directions",
        )
    }
    reference = "Wang, O'Brien, Ramamoorthi, Data-driven elastic models for cloth, SIGGRAPH 2011; CaPhy eq. 4-7"

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        return energy_density(strain, p["stretching"])

    def _responded(self, strain: Symmetric, e: Elements, p: Values) -> tuple[Symmetric, Tangent]:
        """The same by compiled loops, in double precision on the CPU: forty times as fast as torch's derivatives."""
        if strain[0].device.type != "cpu" or strain[0].dtype != torch.float64:
            return super()._responded(strain, e, p)
        from caphy.effects.measured_kernels import measured_response

        table = p["stretching"].detach()
        uu, vv, uv = (part.detach().reshape(-1).numpy() for part in strain)
        found = np.empty((9, len(uu)))
        measured_response(uu, vv, uv, table[0].numpy(), directed(table).numpy(), found)
        suu, svv, suv, t00, t11, t22, t01, t02, t12 = torch.from_numpy(found).reshape(9, *strain[0].shape)
        return (suu, svv, suv), (t00, t11, t22, t01, t02, t12)


def energy_density(strain: Symmetric, table: Tensor) -> Tensor:
    """Energy per rest area (..., n) [N/m] of Green strains uu, vv, uv (..., n) and a stretching table (6, 4)."""
    uu, vv, uv = strain
    k0, k1, k2, k3 = _stiffness(strain, table)
    return 0.5 * (k0 * uu * uu + k2 * vv * vv) + k1 * uu * vv + k3 * uv * uv


def _stiffness(strain: Symmetric, table: Tensor) -> Tensor:
    """K_0 ... K_3 (4, ..., n) [N/m] of the class docstring."""
    uu, vv, uv = strain
    half = 0.5 * (uu - vv)
    radius = torch.sqrt(half * half + uv * uv + SMOOTHING**2)
    largest = _positive(0.5 * (uu + vv) + radius - SMOOTHING)
    cosine = half / radius
    column = (4, *(1,) * uu.dim())
    start = table[0].reshape(column)
    c0, c1, c2, c3, c4, flat = (row.reshape(column) for row in directed(table))
    sampled = _flattened(c0 + cosine * (c1 + cosine * (c2 + cosine * (c3 + cosine * c4))), flat)
    return LOADED_TWICE * _mean_clamped(start, sampled, largest)


def directed(table: Tensor) -> Tensor:
    """Coefficients (5, 4) [N/m] of the polynomials in cos(2 angle) through the rows at 16.7 % stretch, and in a sixth
    row below what each stiffness is led through zero [N/m]."""
    rows = table[1:]
    usual = rows.square().mean(dim=0, keepdim=True).clamp_min(1e-30).sqrt()
    return torch.cat([_polynomial(table.dtype, table.device) @ rows, FLATTENED * usual])


@cache
def _polynomial(dtype: torch.dtype, device: torch.device) -> Tensor:
    """:data:`_POLYNOMIAL` where it is used: brought to a GPU once, which would wait for it every time."""
    return torch.as_tensor(_POLYNOMIAL, dtype=dtype, device=device)


def _mean_clamped(start: Tensor, sampled: Tensor, strain: Tensor) -> Tensor:
    """2 int_0^1 tau max(k(tau g), 0) dtau of k = start + s (sampled - start) at largest principal strains g >= 0."""
    rise = sampled - start
    whole = start + _mean_weight(strain) * rise
    zero = (-start / torch.where(rise == 0, 1, rise)).clamp(0, 1)  # the weight at which k changes sign
    strain_there = zero * STRETCH_SAMPLED * (1 + 0.5 * zero * STRETCH_SAMPLED)
    before = (strain_there / torch.maximum(strain, strain_there).clamp_min(SMOOTHING**2)) ** 2
    before = before * (start + _mean_weight(strain_there) * rise)
    changes = (_weight(strain) > zero) & ((start * sampled < 0) | ((start == 0) & (sampled < 0)))
    falling = torch.where(changes, before, whole)
    rising = torch.where(changes, whole - before, torch.zeros_like(whole))
    return torch.where(start >= 0, falling, torch.where(sampled > 0, rising, torch.zeros_like(whole)))


def _flattened(stiffness: Tensor, flat: Tensor) -> Tensor:
    """A stiffness that goes through zero without slope, as its positive part then does; twice differentiable."""
    t = (stiffness / flat).clamp(-1, 1)
    within = flat * t**3 * (6 - 8 * t.abs() + 3 * t**2)
    return torch.where(stiffness.abs() < flat, within, stiffness)


def _positive(strain: Tensor) -> Tensor:
    """max(strain, 0) with a smooth corner that is zero at zero."""
    strain = strain.clamp_min(0)
    return strain**3 / (strain * strain + SMOOTHING**2)


def _weight(strain: Tensor) -> Tensor:
    """The published weight s in [0, 1] of the sampled rows at largest principal strains: stretch less one, over 1/6."""
    return (2 * strain / (torch.sqrt(1 + 2 * strain) + 1) / STRETCH_SAMPLED).clamp_max(1)


def _mean_weight(strain: Tensor) -> Tensor:
    """2 int_0^1 tau s(tau g) dtau at largest principal strains g >= 0, rational in the stretch less one."""
    d = _weight(strain) * STRETCH_SAMPLED
    within = d * (2 + d * (2.25 + 0.6 * d)) / (3 * STRETCH_SAMPLED * (1 + 0.5 * d) ** 2)
    return 1 - (LARGEST / strain.clamp_min(LARGEST)) ** 2 * (1 - within)
