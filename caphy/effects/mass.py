"""Mass that a garment has beyond its cloth: inertia, and weight where it counts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Values
from caphy.effects.vectors import dot, isotropic, uniform
from caphy.errors import CaphyError

if TYPE_CHECKING:
    from caphy.effects.potential import Potential


class Mass(Effect):
    """Base of vertices with extra mass m, E = m (|x - target|^2 / (2 dt^2) - g.x) [J]; subclasses define ``mass``.

    g is the gravity of the model. In statics only the weight is left. Negative mass is what the cloth has too much of.
    """

    element = "vertex"
    group = "mass"
    reads_step = True
    borrows = ("gravity",)

    def mass(self, e: Elements, p: Values) -> Tensor:
        """Extra mass of each vertex (n,) [kg]."""
        raise NotImplementedError(f"{type(self).__name__} must define mass(e, p)")

    def energy(self, e: Elements, p: Values) -> Tensor:
        (x,) = e.x
        height = -dot(uniform(p["gravity.acceleration"], x), x)
        if e.target is None or e.dt is None:
            return self.mass(e, p) * height
        offset = x - e.target[0]
        return self.mass(e, p) * (dot(offset, offset) / (2 * e.dt**2) + height)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        force = -uniform(p["gravity.acceleration"], e.x[0]) * torch.ones_like(e.x)
        if e.target is not None and e.dt is not None:
            force = force + (e.x - e.target) / e.dt**2
        return self.energy(e, p), self.mass(e, p) * force

    def hessian(self, e: Elements, p: Values) -> Tensor:
        return isotropic(self._stiffness(e, p), e.x)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return isotropic(self._stiffness(e, p).clamp_min(0), e.x)

    def _stiffness(self, e: Elements, p: Values) -> Tensor:
        mass = self.mass(e, p)
        return torch.zeros_like(mass) if e.dt is None else mass / e.dt**2


def require_mass(potential: Potential) -> None:
    """Raise :class:`CaphyError` where what a garment has too much of, by its model, is more than its cloth."""
    cloth, loads = potential.cloth, []
    rest = torch.as_tensor(cloth.vertices, dtype=potential.dtype, device=potential.device)
    mass = torch.as_tensor(cloth.mass, dtype=potential.dtype, device=potential.device).clone()
    for name, term in potential.terms.items():
        if isinstance(term.effect, Mass):
            elements = potential.elements(term, rest, None, None)
            mass.index_add_(0, term.index.reshape(-1), term.effect.mass(elements, term.values))
            loads.append(name)
    if not (mass > 0).all():
        lightest = int(mass.argmin())
        raise CaphyError(
            f"the mass of every vertex must be positive, but vertex {lightest} has {float(mass[lightest]):.3g} kg of "
            f"{cloth.mass[lightest]:.3g} kg of cloth by {' and '.join(loads)}; change their numbers in the model"
        )
