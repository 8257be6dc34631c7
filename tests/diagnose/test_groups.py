"""What can explain a misfit, and in which pieces."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from caphy.diagnose.groups import explanations
from caphy.effects.model import Model
from caphy.garment.topology import boundary_loops
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})


def study(openings: int) -> Any:
    return SimpleNamespace(on_body=False, openings=openings)


@pytest.mark.parametrize("openings", [0, 1, 2])
def test_each_opening_explains_by_itself(openings):
    found = [group for group in explanations(study(openings), MODEL, MODEL) if group.name == "heavy_hem"]
    assert [group.label for group in found] == [f"heavy_hem.line_density[{place}]" for place in range(openings)]
    assert all(len(group.columns) == 1 and not group.own for group in found)


def test_an_effect_that_was_added_stays_in_pieces_and_one_that_was_given_does_not():
    hemmed = MODEL.with_effect("heavy_hem", line_density=[0.004, 0.0, 0.0, 0.0])
    added = [g.label for g in explanations(study(2), hemmed, MODEL) if g.name == "heavy_hem"]
    assert added == ["heavy_hem.line_density[0]", "heavy_hem.line_density[1]"]
    (given,) = [group for group in explanations(study(2), hemmed, hemmed) if group.name == "heavy_hem"]
    assert given.label == "parameters of heavy_hem" and given.own


def test_vectors_of_one_place_stay_together():
    (wind,) = [group for group in explanations(study(1), MODEL, MODEL) if group.name == "wind_normal"]
    assert wind.label == "wind_normal" and len(wind.columns) == 4


def test_a_study_counts_the_openings_of_its_cloth():
    tube = np.array(
        [[a, b, 3 + a] for a, b in ((0, 1), (1, 2), (2, 0))] + [[b, 3 + b, 3 + a] for a, b in ((0, 1), (1, 2), (2, 0))]
    )
    counted = object.__new__(Study)
    counted.scenes = (SimpleNamespace(garment=SimpleNamespace(faces=tube)),)  # type: ignore[assignment]
    assert counted.openings == len(boundary_loops(tube)) == 2
    pinched = object.__new__(Study)
    pinched.scenes = (SimpleNamespace(garment=SimpleNamespace(faces=np.array([[0, 1, 2], [0, 3, 4]]))),)  # type: ignore[assignment]
    assert pinched.openings == 0
