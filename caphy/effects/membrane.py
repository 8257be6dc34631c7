"""In-plane deformation of a triangle and what every membrane energy derives from it.

With F = [f_u, f_v] (3, 2) the deformation gradient in the thread frame and G = (F^T F - I) / 2 its Green strain, a
membrane energy per rest area psi(G) has the stress S = d psi / d G and the tangent C = d S / d G, and

    d E / d x_i   = A F S w_i
    d2 E / dx_i dx_j = A [ (w_i^T S w_j) I_3 + B_i^T C B_j ],    B_i = d(G_uu, G_vv, 2 G_uv) / d x_i,

where w_i (2,) is the gradient of corner i's hat function [1/m]. Everything is written in planes (see
:mod:`caphy.effects.vectors`): no tiny matrices, so it runs at memory speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Values, clamp_eigenvalues
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import dot

Symmetric = tuple[Tensor, Tensor, Tensor]
"""The entries uu, vv, uv (..., n) of symmetric 2x2 matrices."""

Tangent = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""The entries 00, 11, 22, 01, 02, 12 (..., n) of d(S_uu, S_vv, S_uv) / d(G_uu, G_vv, 2 G_uv)."""


def membrane_rest(cloth: Cloth) -> dict[str, np.ndarray]:
    """Rest constants of a membrane: ``area`` (n,) [m^2], ``hat`` (3, 2, n) [1/m], gradients of the hat functions."""
    b, c = np.moveaxis(cloth.face_inverse, 0, -1)  # rows of the inverse edge matrix, (2, n) each
    return {"area": cloth.face_area, "hat": np.stack([-b - c, b, c])}


@dataclass(frozen=True)
class Deformation:
    """Deformation gradient and Green strain of triangles: u, v (3, ..., n), strain entries (..., n)."""

    u: Tensor
    v: Tensor
    strain: Symmetric

    @classmethod
    def of(cls, e: Elements) -> Deformation:
        """The deformation of face elements whose rest constants are :func:`membrane_rest`'s."""
        a, b, c = e.x
        _, (bu, bv), (cu, cv) = e.rest["hat"]
        ab, ac = b - a, c - a
        u, v = ab * bu + ac * cu, ab * bv + ac * cv
        return cls(u, v, (0.5 * (dot(u, u) - 1), 0.5 * (dot(v, v) - 1), 0.5 * dot(u, v)))


def membrane_gradient(e: Elements, deformation: Deformation, stress: Symmetric) -> Tensor:
    """Gradient (3, 3, ..., n) [N] of membrane elements under a second Piola-Kirchhoff stress [N/m]."""
    area = e.rest["area"]
    uu, vv, uv = (area * entry for entry in stress)
    _, (bu, bv), (cu, cv) = e.rest["hat"]
    pu = uu * deformation.u + uv * deformation.v
    pv = uv * deformation.u + vv * deformation.v
    gradient = pu.new_empty((3, *pu.shape))
    torch.add(pu * bu, pv * bv, out=gradient[1])
    torch.add(pu * cu, pv * cv, out=gradient[2])
    torch.add(gradient[1], gradient[2], out=gradient[0]).neg_()
    return gradient


def membrane_hessian(e: Elements, deformation: Deformation, stress: Symmetric, tangent: Tangent) -> Tensor:
    """Hessian (3, 3, 3, 3, ..., n) [N/m] of membrane elements; semi-definite where stress and tangent are."""
    area, hat = e.rest["area"], e.rest["hat"]
    uu, vv, uv = stress
    t00, t11, t22, t01, t02, t12 = (area * entry for entry in tangent)
    u, v = deformation.u, deformation.v
    shape = u.shape[1:]
    hat = hat.reshape(3, 2, 1, *(1,) * (len(shape) - 1), -1)
    rows = torch.stack([hat[:, 0] * u, hat[:, 1] * v, hat[:, 0] * v + hat[:, 1] * u]).reshape(3, 9, *shape)
    b0, b1, b2 = rows
    stiff = (t00 * b0 + t01 * b1 + t02 * b2, t01 * b0 + t11 * b1 + t12 * b2, t02 * b0 + t12 * b1 + t22 * b2)
    hessian = b0[:, None] * stiff[0]
    hessian.addcmul_(b1[:, None], stiff[1]).addcmul_(b2[:, None], stiff[2])
    hessian = hessian.reshape(3, 3, 3, 3, *shape)
    wu, wv = hat[:, 0, 0], hat[:, 1, 0]
    carried = area * (uu * wu + uv * wv), area * (uv * wu + vv * wv)
    geometric = carried[0][:, None] * wu + carried[1][:, None] * wv
    for axis in range(3):
        hessian[:, axis, :, axis] += geometric
    return hessian


def positive_part(stress: Symmetric) -> Symmetric:
    """Symmetric 2x2 matrices with their negative eigenvalues set to zero, in closed form."""
    uu, vv, uv = stress
    mean, half = 0.5 * (uu + vv), 0.5 * (uu - vv)
    radius = torch.sqrt(half * half + uv * uv)
    low, high = (mean - radius).clamp_min(0), (mean + radius).clamp_min(0)
    middle = 0.5 * (low + high)
    ratio = 0.5 * (high - low) / radius.clamp_min(torch.finfo(radius.dtype).tiny)
    return middle + ratio * half, middle - ratio * half, ratio * uv


class Membrane(Effect):
    """Base of faces whose energy per rest area is a function of the Green strain; subclasses define ``density``."""

    element = "face"
    internal = True
    semidefinite: ClassVar[bool] = False
    """Whether the tangent is positive semi-definite at every strain, so that nothing of it is ever left out."""

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return membrane_rest(cloth)

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        """Energy per rest area (..., n) [N/m] of Green strains uu, vv, uv (..., n)."""
        raise NotImplementedError(f"{type(self).__name__} must define density(strain, e, p)")

    def energy(self, e: Elements, p: Values) -> Tensor:
        return e.rest["area"] * self.density(Deformation.of(e).strain, e, p)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        deformation = Deformation.of(e)
        density, stress = self._stressed(deformation.strain, e, p)
        return e.rest["area"] * density, membrane_gradient(e, deformation, stress)

    def response(self, strain: Symmetric, e: Elements, p: Values, convex: bool = False) -> tuple[Symmetric, Tangent]:
        """Stress and tangent at Green strains uu, vv, uv (..., n) [N/m].

        With ``convex`` compressive stress is left out and the tangent's negative eigenvalues are set to zero.
        """
        stress, tangent = self._responded(strain, e, p)
        if convex and self.semidefinite:
            return positive_part(stress), tangent
        return (positive_part(stress), _positive(tangent)) if convex else (stress, tangent)

    def _stressed(self, strain: Symmetric, e: Elements, p: Values) -> tuple[Tensor, Symmetric]:
        """Density (..., n) and stress; override with a closed form where speed pays."""
        density, stress, _ = self._differentiated(strain, e, p, order=1)
        return density, stress

    def _responded(self, strain: Symmetric, e: Elements, p: Values) -> tuple[Symmetric, Tangent]:
        """Stress and tangent; override with a closed form where speed pays."""
        _, stress, tangent = self._differentiated(strain, e, p, order=2)
        return stress, _entries(tangent)

    def hessian(self, e: Elements, p: Values) -> Tensor:
        deformation = Deformation.of(e)
        return membrane_hessian(e, deformation, *self.response(deformation.strain, e, p))

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        deformation = Deformation.of(e)
        return membrane_hessian(e, deformation, *self.response(deformation.strain, e, p, convex=True))

    def _differentiated(
        self, strain: Symmetric, e: Elements, p: Values, order: int
    ) -> tuple[Tensor, Symmetric, Tensor]:
        """Density (..., n), stress and, for order 2, the tangent (3, 3, ..., n), in d / d(uu, vv, 2 uv)."""
        with torch.enable_grad():
            inputs = [part.detach().requires_grad_(True) for part in (strain[0], strain[1], 2 * strain[2])]
            density = self.density((inputs[0], inputs[1], 0.5 * inputs[2]), e, p)
            stress = torch.autograd.grad(density.sum(), inputs, create_graph=order > 1, materialize_grads=True)
            tangent = density.new_empty(0)
            if order > 1:
                tangent = torch.stack([_row(part, inputs) for part in stress])
        uu, vv, uv = (part.detach() for part in stress)
        return density.detach(), (uu, vv, uv), tangent


def _row(stress: Tensor, inputs: list[Tensor]) -> Tensor:
    if not stress.requires_grad:
        return torch.zeros_like(torch.stack(inputs))
    return torch.stack(torch.autograd.grad(stress.sum(), inputs, retain_graph=True, materialize_grads=True))


def _positive(tangent: Tangent) -> Tangent:
    """Tangents without their negative eigenvalues."""
    if tangent[0].device.type == "cpu":
        from caphy.effects.tangent_kernels import positive_tangents

        entries = torch.stack(tangent).detach()
        found = torch.empty_like(entries, memory_format=torch.contiguous_format)
        positive_tangents(entries.reshape(6, -1).numpy(), found.view(6, -1).numpy())
        return tuple(found)  # pyright: ignore
    whole = torch.stack([tangent[place] for place in _PLACES]).unflatten(0, (3, 3))
    return _entries(clamp_eigenvalues(whole[None, :, None])[0, :, 0])


_PLACES = (0, 3, 4, 3, 1, 5, 4, 5, 2)  # of the entries of a whole tangent, row by row


def _entries(tangent: Tensor) -> Tangent:
    return tangent[0, 0], tangent[1, 1], tangent[2, 2], tangent[0, 1], tangent[0, 2], tangent[1, 2]


def strain_of(e: Elements, x: Tensor) -> Symmetric:
    """Green strain of face elements at other positions (3, 3, ..., n) [m], such as those of the history."""
    return Deformation.of(Elements(x, e.rest)).strain


def strain_rate(strain: Symmetric, e: Elements) -> Symmetric:
    """Change of the Green strain over the step per second (..., n) [1/s], from where it set out to ``strain``."""
    assert e.dt is not None
    then = e.then("strain", lambda x: torch.stack(strain_of(e, x)))
    uu, vv, uv = ((now - before) / e.dt for now, before in zip(strain, then, strict=True))
    return uu, vv, uv


def square(strain: Symmetric) -> Tensor:
    """tr(G^2) (..., n)."""
    uu, vv, uv = strain
    return uu * uu + vv * vv + 2 * uv * uv
