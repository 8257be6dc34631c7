"""Drag of still air across the cloth, growing linearly with speed."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import cross, dot, norm


class AirDragNormal(Effect):
    """Linear drag against motion along the normal, E = dt c A / 2 (v.n)^2 [J] per face.

    A is the face's rest area, v the mean velocity of its corners, n its normal at the last converged state. The force
    is -c A (v.n) n, shared by the corners. The default is the slope of 1/2 rho C_d v^2 at 1 m/s in air.
    """

    name = "air_drag_normal"
    element = "face"
    parameters = {"coefficient": Parameter(1.2, "N s/m^3", 0.0, 1e3, doc="pressure per speed")}
    reference = "Baraff, Witkin, Large steps in cloth simulation, SIGGRAPH 1998, section 4.5 (drag)"
    needs_step = True

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"area": cloth.face_area}

    def energy(self, e: Elements, p: Values) -> Tensor:
        normal, weight = _normal_and_weight(e, p)
        speed = dot(normal, e.velocity.mean(0))
        return 0.5 * weight * speed * speed

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        assert e.dt is not None
        normal, weight = _normal_and_weight(e, p)
        speed = dot(normal, e.velocity.mean(0))
        force = weight * speed / (3 * e.dt) * normal
        return 0.5 * weight * speed * speed, torch.stack([force, force, force])

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Constant and positive semi-definite."""
        assert e.dt is not None
        normal, weight = _normal_and_weight(e, p)
        block = weight / (3 * e.dt) ** 2 * normal[:, None] * normal
        return block[None, :, None].expand(3, 3, 3, *block.shape[1:])

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)


def _normal_and_weight(e: Elements, p: Values) -> tuple[Tensor, Tensor]:
    assert e.lagged is not None and e.dt is not None
    a, b, c = e.lagged
    across = cross(b - a, c - a)
    return across / norm(across), e.dt * p["coefficient"] * e.rest["area"]
