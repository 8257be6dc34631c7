"""What a shirt keeps from the body for what is worn beneath it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from dressed_scans import GARMENTS, Subject, look

from caphy.body.bundled import default_body
from caphy.body.surface import Surface
from caphy.commands.register import _outermost
from caphy.garment.families import Skirt, Tshirt, make
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.register import layers
from caphy.register.articulation import Figure, Placement
from caphy.register.cloud import Cloud
from caphy.register.points import ScanPoints
from caphy.register.starts import plain_poses
from caphy.register.template import Choice
from caphy.scan.scan import LOWER, UPPER

BODY = default_body()
FIGURE, MARKS = Figure.of(BODY), Landmarks.of(BODY)
TROUSERS = Garment.load(GARMENTS / "trousers.npz")


def test_a_shirt_keeps_outside_of_what_it_hangs_over():
    height = Surface.of(BODY.faces, MARKS.vertices).nearest(TROUSERS.vertices, MARKS.vertices).distance
    hem = MARKS.crotch + 0.03
    shirt = make(layers.over(Tshirt(), TROUSERS, FIGURE), BODY)
    below = shirt.vertices[:, 1] < hem + 0.15
    assert below.sum() > 100
    assert (shirt.layer_thickness[below] > np.quantile(height[TROUSERS.vertices[:, 1] > hem], 0.85)).all()
    assert (shirt.layer_thickness[below] < 0.015).all()


def test_a_shirt_that_ends_above_keeps_nothing_and_a_wide_skirt_is_pressed_in():
    short = Tshirt(length=MARKS.joint("neck")[1] - TROUSERS.vertices[:, 1].max() - 0.01)
    assert layers.over(short, TROUSERS, FIGURE) == short
    assert layers.over(Tshirt(), make(Skirt(flare=0.35), BODY), FIGURE).layer_thickness == layers.MOST


@pytest.mark.parametrize("tucked", [False, True])
def test_a_shirt_that_is_tucked_in_keeps_nothing(tucked):
    """What the scans show decides: of a tucked shirt nothing below the waistband."""
    place, shirt = plain_poses()[1], make(Tshirt(), BODY)
    seen = shirt
    if tucked:
        above = (shirt.vertices[:, 1] > TROUSERS.vertices[:, 1].max() - 0.01)[shirt.faces].all(axis=1)
        seen = replace(shirt, faces=shirt.faces[above], material=shirt.material[above])
    person = Subject(BODY, np.zeros(10), np.zeros_like(BODY.v_template), [seen, TROUSERS])
    sight = look(person, place.pose, place.transl, 0, 12000)
    assert (sight.labels == UPPER).any() and (sight.labels == LOWER).any()
    cloud = Cloud("scan", sight.points, sight.normals, sight.labels)
    points = [ScanPoints.of(cloud, Placement.of(place.pose, place.transl))]
    choice = _outermost(Choice(Tshirt(), 0.01, 300, ()), TROUSERS, FIGURE, points)
    assert (choice.style.layer_thickness == 0) == tucked
