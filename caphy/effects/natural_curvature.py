"""Natural curvature: cloth that rolls up by itself along its weft or warp."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.cloth import Cloth
from caphy.effects.hinge import turn
from caphy.effects.lending import OfBending, bending_energy, bending_rest
from caphy.effects.membrane import membrane_rest


class NaturalCurvature(OfBending):
    """Rest angles turned by theta_n, E = psi(theta - theta_rest - theta_n) - psi(theta - theta_rest) [J] per hinge.

    psi is the model's own bending, with whatever else stiffens its folds by a law of the angle alone, so that with them
    the sum is that of cloth which rests curved: its weft threads bent by the curvature kappa_u, its warp threads by
    kappa_v, away from the normal (a ridge seen from outside). theta_n is the angle that the very same hinge has on the
    surface w = -(kappa_u u^2 + kappa_v v^2) / 2, to first order.
    """

    name = "natural_curvature"
    lacks = {
        "rests_at_rest": "it changes the shape that rests",
        "projection_is_semidefinite": "a constant or negative moment has a Gauss-Newton Hessian of zero",
    }
    group = "rest shape"
    parameters = {
        "weft": Parameter(5.0, "1/m", -1e3, 1e3, linear=False, doc="curvature at which the weft threads rest"),
        "warp": Parameter(5.0, "1/m", -1e3, 1e3, linear=False, doc="curvature at which the warp threads rest"),
    }
    coefficients = ("weft", "warp")
    reference = "Grinspun et al., Discrete shells, SCA 2003 (rest angles); Timoshenko, Bi-metal thermostats, 1925"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        weft, warp = _angles_per_curvature(cloth)
        return {**bending_rest(cloth), "weft_angle": weft, "warp_angle": warp}

    def bent(self, angle: Tensor, e: Elements, p: Values) -> Tensor:
        natural = p["weft"] * e.rest["weft_angle"] + p["warp"] * e.rest["warp_angle"]
        curved, plain = turn(angle, e.rest["angle"] + natural), turn(angle, e.rest["angle"])
        return bending_energy(curved, e, p) - bending_energy(plain, e, p)


def _angles_per_curvature(cloth: Cloth) -> np.ndarray:
    """Dihedral angle of each hinge per curvature of weft and of warp (2, H) [rad m].

    Each face keeps to the plane through its three raised corners; its slope away from the edge is that plane's.
    """
    faces = cloth.hinge_faces
    corners, material = cloth.faces[faces], cloth.material[faces]  # (H, 2, 3), (H, 2, 3, 2)
    hats = np.moveaxis(membrane_rest(cloth)["hat"], -1, 0)[faces]  # (H, 2, 3, 2)
    wing = (corners == cloth.hinges[:, 2:, None])[..., None]
    middle = np.where(wing, 0, material).sum(2, keepdims=True) / 2
    away = np.where(wing, hats, 0).sum(2)
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    fall = 0.5 * (material - middle) ** 2
    return np.einsum("hfcd,hfce,hfe->dh", fall, hats, away)
