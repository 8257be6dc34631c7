"""The battery over every registered effect."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from caphy.effects.battery import CHECKS
from caphy.effects.registry import registered_effects

WORLD = {
    "gust": "the wind blows in a direction of the world",
    "wind_field": "the wind has a place and a direction in the world",
    "wind_normal": "the wind blows in a direction of the world",
    "wind_normal_quadratic": "the wind blows in a direction of the world",
    "wind_tangential": "the wind blows in a direction of the world",
    "wind_tangential_quadratic": "the wind blows in a direction of the world",
    "gravity": "the world has an up",
    "extra_mass": "weight: the world has an up",
    "mass_gradient": "weight: the world has an up",
    "heavy_hem": "weight: the world has an up",
    "uniform_acceleration": "it has a direction of the world",
}
RESHAPED = ("shrinkage", "shrinkage_directional", "natural_curvature", "seam_tension")
CONSTANT = "where it is a constant or negative moment, the Gauss-Newton Hessian of a hinge is rightly zero"
EXCEPTIONS = {
    ("natural_curvature", "projection_is_semidefinite"): CONSTANT,
    ("bending_anisotropy", "projection_is_semidefinite"): CONSTANT,
    ("plastic_crease", "projection_is_semidefinite"): CONSTANT,
    **{(name, "rests_at_rest"): "it changes the shape that rests" for name in RESHAPED},
    ("softening", "projection_is_semidefinite"): "it takes tension away: where cloth is taut its Hessian is negative",
    ("bending_measured", "units_fit"): "its table is measured at fixed curvatures in 1/m",
    **{(name, "same_in_every_frame"): reason for name, reason in WORLD.items()},
}
"""Properties that an effect lacks for a reason; if it has one after all, the test fails."""


def cases() -> list:
    return [
        pytest.param(
            name,
            check,
            id=f"{name}-{check.__name__}",
            marks=[pytest.mark.xfail(reason=EXCEPTIONS[name, check.__name__], raises=AssertionError, strict=True)]
            if (name, check.__name__) in EXCEPTIONS
            else [],
        )
        for name in registered_effects()
        for check in CHECKS
    ]


@pytest.mark.parametrize(("name", "check"), cases())
def test_effect(name: str, check: Callable[[str], None]) -> None:
    check(name)
