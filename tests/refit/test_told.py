"""What `caphy refit` says of numbers that are not fitted, and `caphy compare` of a model that lacks what cloth has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.commands.refit import table
from caphy.effects.model import Model
from caphy.measure.prediction import _lacking
from caphy.refit.heldout import HeldOut
from caphy.refit.refit import Refit

HELD_OUT = HeldOut(5.0, 4.0, None, *2 * (np.ones(1),), 0.3, 0.1)
PLAIN = Model(0.2, {"inertia": {}, "gravity": {}})


def test_numbers_in_which_an_effect_is_not_linear_are_told_to_be_held():
    """A gust whose frequency was not fitted, and one whose was."""
    gusty = PLAIN.with_effect("gust", frequency=1.5)
    told = {f"gust.{way}[{axis}]": (0.1, 0.05, 0.15, "Pa") for way in ("cosine", "sine") for axis in range(3)}
    said = table(Refit(gusty, ("gust",), (), told, HELD_OUT, "", 0.3))
    assert "gust.frequency is held at 1.5 1/s" in said
    fitted = told | {"gust.frequency": (1.5, 1.4, 1.6, "1/s")}
    assert "held at" not in table(Refit(gusty, ("gust",), (), fitted, HELD_OUT, "", 0.3))


@pytest.mark.parametrize(
    ("effects", "said"),
    [({"inertia": {}, "gravity": {}}, ""), ({"inertia": {}}, "no gravity;"), ({}, "no inertia and no gravity;")],
)
def test_what_every_cloth_has_is_missed(effects, said):
    found = _lacking(Model(0.2, effects))
    assert bool(found) == bool(said) and said in " ".join(found)


@pytest.mark.parametrize(("of_clouds", "most"), [(False, ""), (True, "at most ")])
def test_noise_of_clouds_is_an_upper_bound(of_clouds, most):
    held = replace(HELD_OUT, floor_mm=1.5, of_clouds=of_clouds)
    assert f"; noise alone gives {most}1.50 mm" in table(Refit(PLAIN, (), (), {}, held, "", 0.3))


def test_relative_changes_are_told_as_such():
    """-0.9 stood under "value", beside numbers in N/m; as far as a number is moved more may be right."""
    told = {
        "strain_stvk.lame_mu": (-0.7, -1.0, -0.03, "relative"),
        "strain_stvk.lame_lambda": (-0.9, -1.0, 0.2, "relative"),
        "body_friction.coefficient": (0.4, 0.3, 0.5, "1"),
    }
    first, second, third = table(Refit(PLAIN, (), (), told, HELD_OUT, "", 0.3)).splitlines()[1:4]
    assert "-70 %" in first and "-100 to -3 % of what it was" in first and "as far as" not in first
    assert "as far as it is moved (10 times)" in second
    assert third.endswith("0.4   0.3 to 0.5")
