"""How strong hidden effects are."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.challenge.hidden import HIDDEN, ONE
from caphy.challenge.square import MODEL


@pytest.mark.parametrize("name", ["air_drag_normal", "wind_normal", "uniform_acceleration", "pressure"])
def test_forces_on_a_shirt_are_four_times_as_strong_and_of_the_same_wind(name: str) -> None:
    square, shirt = (ONE[name].drawn(np.random.default_rng(3), scene).effects[name] for scene in ("square", "tshirt"))
    for key, value in square.items():
        np.testing.assert_allclose(shirt[key], 4 * value)


@pytest.mark.parametrize("scene", ["square", "skirt", "tshirt"])
def test_strengths_are_near_the_usual_ones(scene: str) -> None:
    usual = ONE["shrinkage"].effects["shrinkage"]["fraction"]
    drawn = [
        HIDDEN["air_drag_normal and shrinkage"].drawn(np.random.default_rng(seed), scene).effects["shrinkage"]
        for seed in range(20)
    ]
    shares = np.array([each["fraction"] for each in drawn]) / usual
    assert shares.min() >= 0.75 and shares.max() <= 1.4 and np.ptp(shares) > 0.3


def test_a_hidden_anisotropy_leaves_cloth_stiff_in_all_directions() -> None:
    """It takes off one thread's bending what it adds to the other's."""
    least = min(MODEL.effects["bending"].values())
    for seed in range(100):
        hidden = ONE["bending_anisotropy"].drawn(np.random.default_rng(seed)).effects["bending_anisotropy"]
        assert abs(hidden["difference"]) < least
