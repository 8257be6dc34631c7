"""Cloth that keeps a greater distance from the body: thicker cloth, or something worn below."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.body_contact import depth, penalty
from caphy.effects.cloth import Cloth

_THINNEST = 1e-3
"""Depth over which the push grows, at least [m], or all that it did without: it goes by the square, and none would be
no contact."""


class ContactThickness(Effect):
    """Contact that begins earlier by a thickness t, E = k a (p(d + t) - p(d)) [J] per vertex.

    p is the penalty of body_contact, d the signed depth below the model's contact distance and k the stiffness of the
    model's body_contact, so that with it the sum is contact at the greater distance. Negative t lets the cloth come
    nearer, and where it exceeds the model's distance, into the body. The push grows over the distance that is left, but
    over a millimetre at least, or all of a model's distance that is less.
    """

    name = "contact_thickness"
    element = "vertex"
    group = "contact"
    parameters = {"thickness": Parameter(0.002, "m", -0.02, 0.05, linear=False, doc="extra distance from the body")}
    coefficients = ("thickness",)
    reference = "Santesteban, Otaduy, Casas, SNUG, CVPR 2022, eq. 10 (its delta)"
    needs_body = True
    borrows = ("body_contact",)

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"area": cloth.vertex_area, "layer": cloth.layer_thickness}

    def energy(self, e: Elements, p: Values) -> Tensor:
        (thick, thick_skin), (plain, skin) = self._depths(e, p)
        return p["body_contact.stiffness"] * e.rest["area"] * (penalty(thick, thick_skin) - penalty(plain, skin))

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        assert e.body is not None
        thick, plain = (torch.minimum(deep, skin) for deep, skin in self._depths(e, p))
        push = p["body_contact.stiffness"] * e.rest["area"] * (thick**2 - plain**2)
        return self.energy(e, p), (-3 * push * e.body["normal"])[None]

    def hessian(self, e: Elements, p: Values) -> Tensor:
        return self._stiff(e, p, self._slope(e, p))

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self._stiff(e, p, self._slope(e, p).clamp_min(0))

    def _slope(self, e: Elements, p: Values) -> Tensor:
        thick, plain = (torch.where(deep < skin, deep, 0) for deep, skin in self._depths(e, p))
        return thick - plain

    def _depths(self, e: Elements, p: Values) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Depth and depth of the skin, with the thickness and without."""
        below, skin = depth(e, p["body_contact.distance"]), p["body_contact.distance"] + e.rest["layer"]
        thicker = torch.maximum(skin + p["thickness"], skin.clamp_max(_THINNEST))
        return ((below + p["thickness"]).clamp_min(0), thicker), (below.clamp_min(0), skin)

    def _stiff(self, e: Elements, p: Values, depth: Tensor) -> Tensor:
        assert e.body is not None
        normal = e.body["normal"]
        slope = 6 * p["body_contact.stiffness"] * e.rest["area"] * depth
        return (slope * normal[:, None] * normal)[None, :, None]
