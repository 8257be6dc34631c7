"""A rest mesh of another size is doubted, whatever the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_measurements import swinging

from caphy.measure.pace import slowed
from caphy.measure.remarks import remarks
from caphy.measure.size import misfitting


@pytest.mark.parametrize(("factor", "doubted"), [(1.0, False), (1.05, False), (0.8, True), (1.3, True)])
@pytest.mark.parametrize("noise_mm", [0.0, 3.0])
def test_a_rest_mesh_of_another_size_is_doubted(factor, doubted, noise_mm):
    sheet = swinging()
    noise = np.random.default_rng(0).normal(0, 1e-3 * noise_mm, sheet.vertices.shape)
    given = replace(
        sheet, vertices=sheet.vertices + noise, rest_vertices=factor * sheet.rest_vertices, noise_mm=noise_mm or None
    )
    said = misfitting(given)
    assert (said is not None) == doubted
    if said is not None:
        told = float(said.split(" has edges ")[1].split()[0])
        assert told == pytest.approx(1 / factor, abs=0.02)
        assert said in remarks([given])


@pytest.mark.parametrize("stated_mm", [8.0, 100.0])
def test_noise_that_is_stated_in_another_unit_makes_no_edges_short(stated_mm):
    sheet = swinging()
    noise = np.random.default_rng(0).normal(0, 1e-3, sheet.vertices.shape)
    assert misfitting(replace(sheet, vertices=sheet.vertices + noise, noise_mm=stated_mm)) is None


def test_nothing_is_said_without_a_rest_mesh():
    assert misfitting(replace(swinging(), rest_vertices=None)) is None


def test_what_is_said_of_several_is_said_once():
    fast = replace(swinging(), fps=120.0)
    one, two = (replace(fast, name=name) for name in ("one", "two"))
    assert remarks([one]) == [slowed(one)]
    (both,) = remarks([one, two, swinging()])
    assert both == f"one, two: each {slowed(one).removeprefix('one ')}"
