"""Shrinkage of the cloth, as after a wash."""

from __future__ import annotations

from torch import Tensor

from caphy.effects.base import Elements, Parameter, Values
from caphy.effects.lending import OfMembrane, membrane_density
from caphy.effects.membrane import Symmetric


class Shrinkage(OfMembrane):
    """A rest shape smaller by a fraction s in all directions, E = A ((1 - s)^2 psi(G') - psi(G)) [J] per face.

    psi is the model's own membrane, with whatever else stiffens it in its plane by a law of the strain alone, and G'
    the strain from the smaller rest shape, G' = ((F^T F) / (1 - s)^2 - I) / 2, so that with their own energy the sum is
    that of the same cloth cut smaller. Mass and the rest angles of folds stay. Negative s lets the cloth grow.
    """

    name = "shrinkage"
    lacks = {"rests_at_rest": "it changes the shape that rests"}
    group = "rest shape"
    parameters = {"fraction": Parameter(0.03, "1", -0.5, 0.5, linear=False, doc="share of each length that is lost")}
    coefficients = ("fraction",)
    reference = "multiplicative split of eigenstrain: Lee, Elastic-plastic deformation at finite strains, 1969"

    def density(self, strain: Symmetric, e: Elements, p: Values) -> Tensor:
        return shrunk_density(strain, 1 - p["fraction"], 1 - p["fraction"], e, p)


def shrunk_density(strain: Symmetric, weft: Tensor, warp: Tensor, e: Elements, p: Values) -> Tensor:
    """Energy per area of the uncut cloth (..., n) [N/m] that a rest shape scaled along weft and warp adds."""
    uu, vv, uv = strain
    cut = (uu + 0.5) / weft**2 - 0.5, (vv + 0.5) / warp**2 - 0.5, uv / (weft * warp)
    return weft * warp * membrane_density(cut, e, p) - membrane_density(strain, e, p)
