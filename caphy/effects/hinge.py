"""The dihedral angle of a hinge - two triangles that share an edge - and its gradient.

A hinge is [edge a, edge b, wing c, wing d] with faces (a, b, c) and (b, a, d). The angle between the two normals is
zero when flat and positive where the faces bend away from their normals (a ridge seen from outside).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Values, gradient_jacobian
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import cross, dot, outer

COLLAPSED = 1e-3
"""Below this fraction of its rest size a triangle or edge counts as collapsed and its angle gradient stops growing."""


def hinge_rest(cloth: Cloth) -> dict[str, np.ndarray]:
    """Rest constants of hinges: ``length`` [m], ``area`` of both faces [m^2], ``angle`` [rad], (n,) each."""
    x = torch.as_tensor(cloth.vertices[cloth.hinges], dtype=torch.float64).movedim(0, -1)
    return {
        "length": np.linalg.norm(cloth.hinge_edges, axis=-1).mean(-1),
        "area": cloth.face_area[cloth.hinge_faces].sum(-1),
        "angle": dihedral(x).numpy(),
    }


def dihedral(x: Tensor) -> Tensor:
    """Signed angle (..., n) [rad] in (-pi, pi] of hinges (4, 3, ..., n); zero where a triangle has no area."""
    a, b, c, d = x
    edge, wing = b - a, d - a
    normal_c, normal_d = cross(edge, c - a), cross(wing, edge)
    length = torch.sqrt(dot(edge, edge).clamp_min(torch.finfo(x.dtype).tiny))
    sine, cosine = -length * dot(normal_c, wing), dot(normal_c, normal_d)
    collapsed = (sine == 0) & (cosine == 0)
    return torch.atan2(sine, torch.where(collapsed, torch.ones_like(cosine), cosine))


def turn(angle: Tensor, rest: Tensor) -> Tensor:
    """By how much hinges are turned from their rest angles (..., n) [rad], in [-pi, pi).

    A hinge folded flat may pass through itself, from pi to -pi; wrapping keeps the energy free of a jump there.
    """
    turned = angle - rest
    return turned - 2 * torch.pi * torch.floor(turned / (2 * torch.pi) + 0.5)


def dihedral_gradient(x: Tensor, length: Tensor, area: Tensor) -> tuple[Tensor, Tensor]:
    """Angles (..., n) [rad] of hinges (4, 3, ..., n) and their gradients (4, 3, ..., n) [rad/m].

    Raising a wing along its normal turns it by 1 / height, and the edge's ends take the reaction so that no net force
    or torque is left (Bridson et al., SCA 2003). ``length`` [m] and ``area`` [m^2] at rest (n,) say what counts as
    collapsed; there the gradient is bounded instead of infinite.
    """
    a, b, c, d = x
    edge, wing_c, wing_d = b - a, c - a, d - a
    normal_c, normal_d = cross(edge, wing_c), cross(wing_d, edge)
    square = dot(edge, edge)
    edge_length = torch.sqrt(square.clamp_min(torch.finfo(x.dtype).tiny))
    angle = torch.atan2(-edge_length * dot(normal_c, wing_d), dot(normal_c, normal_d))

    smallest = (COLLAPSED * area) ** 2
    slope_c = -edge_length / torch.maximum(dot(normal_c, normal_c), smallest) * normal_c
    slope_d = -edge_length / torch.maximum(dot(normal_d, normal_d), smallest) * normal_d
    inverse = 1 / torch.maximum(square, (COLLAPSED * length) ** 2)
    at_b = (dot(wing_c, edge) * inverse) * slope_c + (dot(wing_d, edge) * inverse) * slope_d
    return angle, torch.stack([at_b - slope_c - slope_d, -at_b, slope_c, slope_d])


class Hinge(Effect):
    """Base of hinges whose energy is a function of the dihedral angle; subclasses define ``bent``."""

    element = "hinge"
    internal = True

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return hinge_rest(cloth)

    def bent(self, angle: Tensor, e: Elements, p: Values) -> Tensor:
        """Energy (..., n) [J] of hinges at dihedral angles (..., n) [rad]."""
        raise NotImplementedError(f"{type(self).__name__} must define bent(angle, e, p)")

    def energy(self, e: Elements, p: Values) -> Tensor:
        return self.bent(dihedral(e.x), e, p)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        angle, slope = dihedral_gradient(e.x, e.rest["length"], e.rest["area"])
        energy, moment, _ = self._differentiated(angle, e, p)
        return energy, moment * slope

    def response(self, angle: Tensor, e: Elements, p: Values, convex: bool = False) -> tuple[Tensor, Tensor]:
        """Moment [N m] and its slope [N m] at angles (..., n) [rad]; with ``convex`` the slope is not negative."""
        _, moment, stiffness = self._differentiated(angle, e, p)
        return moment, stiffness.clamp_min(0) if convex else stiffness

    def hessian(self, e: Elements, p: Values) -> Tensor:
        return gradient_jacobian(self, e, p)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        """Gauss-Newton: the curvature of the angle itself is left out, and no hinge has a negative stiffness."""
        angle, slope = dihedral_gradient(e.x, e.rest["length"], e.rest["area"])
        _, stiffness = self.response(angle, e, p, convex=True)
        return outer(stiffness * slope, slope)

    def _differentiated(self, angle: Tensor, e: Elements, p: Values) -> tuple[Tensor, Tensor, Tensor]:
        """Energy, moment [N m] and stiffness [N m] (..., n); the moment stays differentiable if the angle is."""
        with torch.enable_grad():
            turned = angle if angle.requires_grad else angle.detach().requires_grad_(True)
            energy = self.bent(turned, e, p)
            moment = _derivative(energy, turned)
            stiffness = _derivative(moment, turned)
        if angle.requires_grad:
            return energy, moment, stiffness
        return energy.detach(), moment.detach(), stiffness.detach()


def _derivative(value: Tensor, angle: Tensor) -> Tensor:
    if not value.requires_grad:
        return torch.zeros_like(angle)
    return torch.autograd.grad(value.sum(), angle, create_graph=True, materialize_grads=True)[0]
