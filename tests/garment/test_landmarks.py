"""Heights that garments are measured from stay where the body has them, however heavy it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from caphy.body.bundled import default_body
from caphy.body.model import BodyModel
from caphy.errors import CaphyError
from caphy.garment.families import Shorts, make
from caphy.garment.landmarks import Landmarks

LEAN = 0.03
"""Over which thighs come nearer, below the crotch [m]."""


def thighs_at(gap: float, depth_of_gap: float = LEAN) -> BodyModel:
    """The fine default body with its thighs ``gap`` [m] from the middle, from a depth below the crotch [m] on."""
    body = default_body("fine")
    x, y, _ = body.v_template.T
    depth = middle(body) - y
    inner = np.array([np.abs(x[np.abs(depth - d) < 0.012]).min() if 0.01 < d < 0.3 else gap for d in depth])
    share = (
        np.clip((depth - depth_of_gap) / LEAN + 1, 0, 1)
        * np.clip((0.23 - depth) / 0.1, 0, 1)
        * np.clip(2 - np.abs(x) / 0.06, 0, 1)
    )
    vertices = body.v_template.copy()
    vertices[:, 0] -= np.sign(x) * share * np.maximum(inner - gap, 0)
    return replace(body, v_template=vertices)


def middle(body: BodyModel) -> float:
    """Height [m] of the lowest vertex in the middle of the fine body, which is symmetric."""
    x, y, _ = body.v_template.T
    return float(y[(np.abs(x) < 1e-6) & (y < body.joints[0, 1])].min())


@pytest.mark.parametrize("gap", [0.015, 0.009, 0.004, -0.003])
def test_the_crotch_is_between_the_legs_however_near_the_thighs(gap):
    body = thighs_at(gap)
    assert Landmarks.of(body).crotch == pytest.approx(middle(body), abs=0.002)


@pytest.mark.parametrize("depth", [0.03, 0.08])
@pytest.mark.parametrize("gap", [0.009, -0.003])
def test_shorts_part_into_two_legs_on_thighs_that_touch(gap, depth):
    """Cloth that goes round both thighs where there is no way between them has no hole above."""
    body = thighs_at(gap, depth)
    shorts = make(Shorts(leg=0.25, edge_length=0.025), body)
    assert len(shorts.boundary_loops) == 3
    assert trimesh.Trimesh(shorts.vertices, shorts.faces, process=False).euler_number == -1
    assert shorts.vertices[:, 1].min() == pytest.approx(middle(body) - 0.25, abs=0.005)


def test_weights_without_legs_are_named():
    body = default_body("medium")
    weights = np.zeros_like(body.weights)
    weights[:, 0] = 1.0
    with pytest.raises(CaphyError, match=r"skin between its legs.*order of SMPL-X's joints"):
        make(Shorts(), replace(body, weights=weights))
