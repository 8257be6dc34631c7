"""Friction of the cloth on the body."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import Effect, Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.vectors import dot


class BodyFriction(Effect):
    """Coulomb friction on the moving body, E = dt mu N (sqrt(|v_t|^2 + s^2) - s) [J] per vertex.

    v_t is the tangential velocity relative to the body and s the slip speed below which friction is viscous, so that
    the potential is smooth. N = 3 k a d^2 is the normal force of ``body_contact`` and, where the model has it,
    ``contact_thickness``. It is told of other positions than those that are looked for, or there would be no potential:
    of x(t-1) + dt v_body, the last converged state carried along with the body, or of where a solver says that the step
    ends (``pressed``), as the reference solver does, which goes on until that is so.
    """

    name = "body_friction"
    element = "vertex"
    group = "contact"
    parameters = {
        "coefficient": Parameter(0.3, "1", 0.0, 5.0, doc="friction force over normal force"),
        "slip": Parameter(0.01, "m/s", 1e-5, 1.0, linear=False, doc="speed below which friction fades"),
    }
    reference = "Kane, Repetto, Ortiz, Marsden, Finite element analysis of nonsmooth contact, CMAME 180, 1999"
    abrupt = True
    needs_step = True
    needs_body = True
    borrows = ("body_contact",)
    heeds = ("contact_thickness",)

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        return {"area": cloth.vertex_area, "layer": cloth.layer_thickness}

    def energy(self, e: Elements, p: Values) -> Tensor:
        return _grip(e, p) * (_slide(e, p)[1] - p["slip"])

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        assert e.dt is not None
        grip, (slide, speed) = _grip(e, p), _slide(e, p)
        return grip * (speed - p["slip"]), (grip / (e.dt * speed) * slide)[None]

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Positive semi-definite as it stands."""
        slide, speed = _slide(e, p)
        return _stiffness(e, p, slide[:, None] * slide / speed**2)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        """Of a quadratic in the slide that touches the energy and is nowhere below it: a step along it never goes too
        far, where Newton's goes far beyond rest, since the energy of what slides is all but straight."""
        return _stiffness(e, p, torch.zeros_like(e.rest["area"]))


def _stiffness(e: Elements, p: Values, along: Tensor) -> Tensor:
    """grip / (dt^2 speed) (1 - n n^T - along) [N/m], one corner by one corner; ``along`` (3, 3, ..., n) or zero."""
    assert e.dt is not None and e.body is not None
    normal, (_, speed) = e.body["normal"], _slide(e, p)
    identity = torch.eye(3, dtype=normal.dtype, device=normal.device).reshape(3, 3, *(1,) * (normal.dim() - 1))
    plane = identity - normal[:, None] * normal - along
    return (_grip(e, p) / (e.dt**2 * speed) * plane)[None, :, None]


def _grip(e: Elements, p: Values) -> Tensor:
    """dt mu N (..., n) [N s], of the lagged contact force."""
    assert e.lagged is not None and e.body is not None and e.dt is not None
    (pressed,) = e.lagged + e.dt * e.body["velocity"] if e.pressed is None else e.pressed
    height = dot(e.body["normal"], pressed - e.body["point"])
    skin = p["body_contact.distance"] + e.rest["layer"]
    if "contact_thickness.thickness" in p:
        skin = skin + p["contact_thickness.thickness"]
    depth = torch.minimum((skin - height).clamp_min(0), skin.clamp_min(0))  # contact pushes no harder inside
    return 3 * e.dt * p["coefficient"] * p["body_contact.stiffness"] * e.rest["area"] * depth * depth


def _slide(e: Elements, p: Values) -> tuple[Tensor, Tensor]:
    """Tangential velocity relative to the body (3, ..., n) and its smoothed size (..., n) [m/s]."""
    assert e.body is not None
    (velocity,) = e.velocity - e.body["velocity"]
    slide = velocity - dot(velocity, e.body["normal"]) * e.body["normal"]
    return slide, torch.sqrt(dot(slide, slide) + p["slip"] ** 2)
