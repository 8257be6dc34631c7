"""Wind that changes from place to place: shear, swirl, and air that spreads."""

from __future__ import annotations

from torch import Tensor

from caphy.effects.air import Air
from caphy.effects.base import Elements, Parameter, Values


class WindField(Air):
    """A wind pressure that is linear in place, E = -dt A (G x.n) (v.n) [J] per face, x its lagged centre.

    G x [Pa] is the push of the air at x, measured from the world's origin: the rows of G are the components of the
    push, its columns how they change along x, y and z. A symmetric G spreads or squeezes, an antisymmetric one
    swirls; the default is wind along x that grows with height. Neither the uniform part nor the cloth's drag is in
    it: those are wind_normal's.
    """

    name = "wind_field"
    lacks = {
        "same_in_every_frame": "the wind has a direction in the world",
        "same_in_every_place": "the wind has a place in the world",
    }
    group = "wind"
    power = 0
    parameters = {
        "gradient": Parameter(
            ((0.0, 0.6, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "N/m^3", -1e3, 1e3, doc="change of pressure with place"
        )
    }
    reference = "Batchelor, An introduction to fluid dynamics, 1967, section 2.3 (flow near a point)"

    def push(self, e: Elements, p: Values) -> Tensor:
        assert e.lagged is not None
        centre = e.lagged.mean(0)
        return (p["gradient"] @ centre.flatten(1)).reshape(centre.shape)
