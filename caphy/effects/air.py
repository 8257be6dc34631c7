"""What air does to the faces of a cloth: drag against the slip through it, and the push of wind.

With v the mean velocity of a face's corners, w that of the air, n the face's normal at the last converged state and
P = n n^T (across the cloth) or I - n n^T (along it), the slip is u = P (v - w) and

    E = dt A (c / (q + 1) |u|^(q + 1) - f . P v) [J],

whose force -A (c |u|^(q - 1) u - P f) the three corners share. q is 1 for the linear law and 2 for the quadratic one,
A the rest area, and f [Pa] a push that does not depend on the cloth's own motion. With the linear law a wind w is the
push f = c w, in which the energy is linear.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import cross, dot, norm

FASTEST = 5.0
"""Wind speed at which a search for it begins at most [m/s]."""


class Air(Effect):
    """Base of the effects of air; subclasses choose direction and law, and what air moves.

    Class attributes:
        across: acts across the cloth, else along it.
        power: q of the drag law; 0 without drag.
    """

    element = "face"
    needs_step = True
    across: ClassVar[bool] = True
    power: ClassVar[int] = 1

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"area": cloth.face_area}

    def wind(self, e: Elements, p: Values) -> Tensor | None:
        """Velocity w of the air (3, ..., n) [m/s]; None if still."""
        return None

    def push(self, e: Elements, p: Values) -> Tensor | None:
        """Push f (3, ..., n) [Pa]; None without."""
        return None

    def energy(self, e: Elements, p: Values) -> Tensor:
        normal, velocity, push = lagged_normal(e), e.velocity.mean(0), self.push(e, p)
        slip = self._slip(e, p, normal, velocity) if self.power else None
        return self._dissipated(e, p, normal, velocity, push, slip)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        normal, velocity, push = lagged_normal(e), e.velocity.mean(0), self.push(e, p)
        force, slip = torch.zeros_like(normal), None
        if self.power:
            slip = self._slip(e, p, normal, velocity)
            force = p["coefficient"] * norm(slip) ** (self.power - 1) * slip
        if push is not None:
            force = force - self._projected(push, normal)
        force = e.rest["area"] / 3 * force
        return self._dissipated(e, p, normal, velocity, push, slip), torch.stack([force, force, force])

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Positive semi-definite: of the dissipation, which is convex; a push has none."""
        assert e.dt is not None
        normal = lagged_normal(e)
        plane = normal[:, None] * normal
        if not self.across:
            identity = torch.eye(3, dtype=normal.dtype, device=normal.device)
            plane = identity.reshape(3, 3, *(1,) * (normal.dim() - 1)) - plane
        block = torch.zeros_like(plane)
        if self.power:
            slip = self._slip(e, p, normal, e.velocity.mean(0))
            speed = norm(slip)
            growth = (self.power - 1) * slip[:, None] * slip / speed**2
            block = p["coefficient"] * speed ** (self.power - 1) * (plane + growth)
        block = e.rest["area"] / (9 * e.dt) * block
        return block[None, :, None].expand(3, 3, 3, *block.shape[1:])

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)

    def _dissipated(
        self, e: Elements, p: Values, normal: Tensor, velocity: Tensor, push: Tensor | None, slip: Tensor | None
    ) -> Tensor:
        """The energy (..., n) [J]."""
        assert e.dt is not None
        density = torch.zeros_like(velocity[0])
        if slip is not None:
            density = p["coefficient"] / (self.power + 1) * norm(slip) ** (self.power + 1)
        if push is not None:
            density = density - dot(push, self._projected(velocity, normal))
        return e.dt * e.rest["area"] * density

    def _slip(self, e: Elements, p: Values, normal: Tensor, velocity: Tensor) -> Tensor:
        wind = self.wind(e, p)
        return self._projected(velocity if wind is None else velocity - wind, normal)

    def _projected(self, field: Tensor, normal: Tensor) -> Tensor:
        across = dot(field, normal) * normal
        return across if self.across else field - across


def squared(found: Mapping[str, np.ndarray], within: Parameter) -> dict[str, Any]:
    """The quadratic law that pushes resting cloth as a linear wind with ``coefficient`` and ``push`` does.

    Where the push f comes with hardly any drag the linear law knows no velocity; then it is :data:`FASTEST`. Where it
    is so slow that the coefficient would leave the bounds of ``within``, the wind is as fast as they need.
    """
    push = np.asarray(found["push"], dtype=float)
    size = max(float(np.linalg.norm(push)), 1e-12)
    speed = min(size / max(float(found["coefficient"]), 1e-12), FASTEST)
    coefficient = float(np.clip(size / speed**2, within.lower, within.upper))
    return {"coefficient": coefficient, "velocity": push / size * np.sqrt(size / coefficient)}


def lagged_normal(e: Elements) -> Tensor:
    """Unit normals (3, ..., n) of faces at the last converged state; zero without area."""
    assert e.lagged is not None
    return e.once("lagged_normal", e.lagged, lambda lagged: _unit(area_vector(lagged)))


def lagged_area(e: Elements) -> Tensor:
    """Area vectors (3, ..., n) [m^2] of faces at the last converged state."""
    assert e.lagged is not None
    return e.once("lagged_area", e.lagged, area_vector)


def area_vector(x: Tensor) -> Tensor:
    """Area vectors (3, ..., n) [m^2] of faces at positions (3, 3, ..., n) [m]."""
    a, b, c = x
    return 0.5 * cross(b - a, c - a)


def _unit(area: Tensor) -> Tensor:
    across = 2 * area
    return across / norm(across)
