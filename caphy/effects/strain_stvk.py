"""In-plane elasticity of a St. Venant-Kirchhoff membrane."""

from __future__ import annotations

import torch
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.membrane import Membrane, Symmetric, Tangent


class StrainStVK(Membrane):
    """Isotropic St. Venant-Kirchhoff membrane, E = A (lambda/2 tr(G)^2 + mu tr(G^2)) [J] per face.

    lambda and mu are those of the sheet [N/m], thickness included. The defaults are SNUG's cotton: Young's modulus
    0.7e5 Pa, Poisson's ratio 0.485, thickness 0.47 mm.
    """

    name = "strain_stvk"
    group = "stiffness"
    parameters = {
        "lame_lambda": Parameter(20.9, "N/m", 0.0, 1e5, doc="first Lame parameter of the sheet"),
        "lame_mu": Parameter(11.1, "N/m", 0.0, 1e5, doc="second Lame parameter (shear) of the sheet"),
    }
    reference = "Santesteban, Otaduy, Casas, SNUG, CVPR 2022, eq. 5; CaPhy eq. 4-6"
    semidefinite = True

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        return stvk_density(strain, p)

    def _stressed(self, strain: Symmetric, e: Elements, p: Values) -> tuple[Tensor, Symmetric]:
        return stvk_density(strain, p), _stress(strain, p)

    def _responded(self, strain: Symmetric, e: Elements, p: Values) -> tuple[Symmetric, Tangent]:
        return _stress(strain, p), _tangent(strain[0], p)


def stvk_density(strain: Symmetric, p: Values) -> Tensor:
    """Energy per rest area (..., n) [N/m] of Green strains uu, vv, uv (..., n)."""
    uu, vv, uv = strain
    trace = uu + vv
    return 0.5 * p["lame_lambda"] * trace * trace + p["lame_mu"] * (uu * uu + vv * vv + 2 * uv * uv)


def _stress(strain: Symmetric, p: Values) -> Symmetric:
    uu, vv, uv = strain
    pressure, double_mu = p["lame_lambda"] * (uu + vv), 2 * p["lame_mu"]
    return pressure + double_mu * uu, pressure + double_mu * vv, double_mu * uv


def _tangent(like: Tensor, p: Values) -> Tangent:
    lame_lambda, mu, zero = p["lame_lambda"], p["lame_mu"], torch.zeros_like(like)
    direct = zero + (lame_lambda + 2 * mu)
    return direct, direct, zero + mu, zero + lame_lambda, zero, zero
