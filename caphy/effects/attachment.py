"""Springs that hold a waistband, or whatever the garment marks as attached, to the body."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import dot, isotropic


class Attachment(Effect):
    """Springs to where the skinned template has each attached vertex, E = k s a / 2 |x - anchor|^2 [J].

    s in [0, 1] is the garment's attachment strength and a the vertex's rest area. At the default stiffness a band
    of 80 cm by 2 cm gives by 0.2 mm under trousers of 3 N.
    """

    name = "attachment"
    element = "vertex"
    group = "contact"
    parameters = {"stiffness": Parameter(1e6, "N/m^3", 0.0, 1e10, doc="spring stiffness per area of attached cloth")}
    reference = "elastic bedding of Winkler, Die Lehre von der Elasticitaet und Festigkeit, 1867"
    needs_body = True

    def index(self, cloth: Cloth) -> np.ndarray:
        return np.flatnonzero(cloth.attached > 0)[:, None]

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        held = cloth.attached > 0
        return {"strength": (cloth.attached * cloth.vertex_area)[held]}

    def energy(self, e: Elements, p: Values) -> Tensor:
        assert e.body is not None
        (offset,) = e.x - e.body["anchor"]
        return 0.5 * p["stiffness"] * e.rest["strength"] * dot(offset, offset)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        assert e.body is not None
        offset = e.x - e.body["anchor"]
        force = p["stiffness"] * e.rest["strength"] * offset
        return 0.5 * dot(force[0], offset[0]), force

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Constant and positive semi-definite."""
        return isotropic(p["stiffness"] * e.rest["strength"], e.x)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)
