"""Vertices that lie where none can be are refused or doubted, with their frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_measurements import swinging

from caphy.errors import CaphyError
from caphy.io.measurements.checks import require_plausible
from caphy.measure.remarks import remarks
from caphy.measure.strays import torn


@pytest.mark.parametrize("noise_mm", [0.0, 3.0])
def test_single_vertices_that_are_elsewhere_are_doubted(noise_mm):
    sheet = swinging()
    noise = np.random.default_rng(0).normal(0, 1e-3 * noise_mm, sheet.vertices.shape)
    seen = replace(sheet, vertices=sheet.vertices + noise, noise_mm=noise_mm or None)
    assert torn(seen) is None
    lost = seen.vertices.copy()
    lost[3, 7] += (0.0, 0.3, 0.2)
    said = torn(replace(seen, vertices=lost))
    assert said is not None and "in 1 of" in said and "those of vertex 7 in frame 3" in said
    assert said in remarks([replace(seen, vertices=lost)])
    assert torn(replace(seen, vertices=lost, visibility=np.arange(lost.shape[1]) != 7 + 0 * lost[..., 0])) is None


def test_places_that_a_rest_mesh_lists_twice_are_refused():
    sheet = swinging()
    rest = sheet.rest_vertices.copy()
    rest[8] = rest[7]
    with pytest.raises(CaphyError, match="rest_vertices 7 and 8 lie on one another and an edge joins them"):
        require_plausible(replace(sheet, rest_vertices=rest))


def test_a_number_that_stands_for_nothing_is_refused():
    sheet = swinging()
    lost = sheet.vertices.copy()
    lost[3, 7:9] = -9999.0
    with pytest.raises(
        CaphyError, match=r"vertex 7 lies 1e\+04 m away from the others in frame 3 \(2 such there\).*NaN"
    ):
        require_plausible(replace(sheet, vertices=lost))
    points, offsets = lost.reshape(-1, 3), np.arange(len(lost) + 1) * lost.shape[1]
    cloud = replace(sheet, vertices=None, points=points, offsets=offsets, pinned=None, pinned_positions=None)
    with pytest.raises(CaphyError, match=r"point 7 lies .* in frame 3 .*leave what was not seen out"):
        require_plausible(cloud)


def test_what_is_hidden_may_be_infinite():
    sheet = swinging()
    lost, seen = sheet.vertices.copy(), np.ones(sheet.vertices.shape[:2], bool)
    lost[3:5, 7], seen[3:5, 7] = np.inf, False
    require_plausible(replace(sheet, vertices=lost, visibility=seen))
