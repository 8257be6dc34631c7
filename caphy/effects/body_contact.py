"""Contact of the cloth with the surface of the body."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import dot


class BodyContact(Effect):
    """Cubic penalty of what comes nearer to the body than a distance, E = k a d^3 [J] per vertex.

    d = max(distance + layer - n.(x - p), 0) with p the nearest point of the body's surface, n its outward normal,
    layer the garment's own extra distance, and a the vertex's rest area. The force and its slope grow from zero, so
    the energy is twice differentiable outside the body. Weighting by area makes 3 k d^2 a pressure [Pa], the same on
    every mesh.

    Inside the body, where d exceeds the distance and the layer, the energy goes on along its tangent: the push is that
    at the skin, which grows with the square of the distance: with none there would be no contact. A cube would let the
    few vertices caught where limb and trunk overlap drown everything else.

    The default stiffness balances 300 Pa 1 mm below the contact distance: a cloth of 0.2 kg/m^2 weighs 2 Pa, and
    one stretched by 20 N/m over a limb of 7 cm radius presses with 300 Pa. SNUG's 250 N/m^2 per vertex is
    1.3e6 N/m^4 on its meshes and lets such a cloth sink to the skin. (CaPhy's eq. 11 is printed with the opposite
    sign, which would pull cloth inwards.)
    """

    name = "body_contact"
    element = "vertex"
    group = "contact"
    parameters = {
        "stiffness": Parameter(1e8, "N/m^4", 0.0, 1e12, doc="pressure per squared depth, over three"),
        "distance": Parameter(
            0.004,
            "m",
            5e-4,
            0.05,
            linear=False,
            doc="distance below which the body pushes; the cloth rests just inside",
        ),
    }
    reference = "Santesteban, Otaduy, Casas, SNUG, CVPR 2022, eq. 10; CaPhy eq. 11 with the sign put right"
    needs_body = True

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"area": cloth.vertex_area, "layer": cloth.layer_thickness}

    def energy(self, e: Elements, p: Values) -> Tensor:
        return p["stiffness"] * e.rest["area"] * penalty(*_depths(e, p))

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        assert e.body is not None
        deep, skin = _depths(e, p)
        push = 3 * p["stiffness"] * e.rest["area"] * torch.minimum(deep, skin) ** 2
        return self.energy(e, p), (-push * e.body["normal"])[None]

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Positive semi-definite as it stands; the body is taken as its tangent plane."""
        assert e.body is not None
        normal = e.body["normal"]
        deep, skin = _depths(e, p)
        slope = 6 * p["stiffness"] * e.rest["area"] * torch.where(deep < skin, deep, 0)
        return (slope * normal[:, None] * normal)[None, :, None]

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        """Inside the body, where the energy is flat and Newton's step endless, half-way to the contact distance."""
        assert e.body is not None
        normal = e.body["normal"]
        deep, skin = _depths(e, p)
        slope = torch.where(deep < skin, deep, skin * skin / deep.clamp_min(1e-12))
        return (6 * p["stiffness"] * e.rest["area"] * slope * normal[:, None] * normal)[None, :, None]


def penalty(deep: Tensor, skin: Tensor) -> Tensor:
    """d^3 [m^3] of depths (..., n) down to the skin, and on along the tangent inside."""
    shallow = torch.minimum(deep, skin)
    return shallow * shallow * (3 * deep - 2 * shallow)


def braked(e: Elements, p: Values, move: Tensor, hold: Tensor) -> Tensor:
    """A move (3, n) [m] of vertices that presses none deeper than where the body's push balances what holds it.

    A step that knows push and slope where it begins, u = 0, knows nothing of 3 k a u^2, which is added u deeper: it
    goes on to U. Held there with ``hold`` (n,) [N/m] a vertex comes to rest where 3 k a u^2 = hold (U - u).
    """
    assert e.body is not None
    normal, begun = e.body["normal"], depth(e, p["distance"])
    over = (begun.clamp_max(0) - dot(normal, move)).clamp_min(0)  # U, from where pushing begins
    grows = (6 * p["stiffness"] * e.rest["area"]).clamp_min(1e-300)
    rest = (torch.sqrt(hold * hold + 2 * grows * hold * over) - hold) / grows
    return move + (over - rest).clamp_min(0) * normal


def depth(e: Elements, distance: Tensor) -> Tensor:
    """How far vertices (..., n) lie below a distance from the body and their own layers [m]; negative above."""
    assert e.body is not None
    (x,) = e.x
    return distance + e.rest["layer"] - dot(e.body["normal"], x - e.body["point"])


def _depths(e: Elements, p: Values) -> tuple[Tensor, Tensor]:
    """The depth, zero above, and that of the skin."""
    return depth(e, p["distance"]).clamp_min(0), p["distance"] + e.rest["layer"]
