"""Eases of a garment, told by hanging it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.effects.cloth import Cloth
from caphy.effects.presets import fabric_model
from caphy.errors import CaphyError
from caphy.garment.families import Trousers, Tshirt, make
from caphy.register.articulation import Figure, Placement
from caphy.register.cloud import Cloud
from caphy.register.eases import Seen, eases_step, hung, hung_eases, widening
from caphy.scan.scan import UPPER

BODY = default_body()
FIGURE = Figure.of(BODY)
FABRIC = "gray-interlock"


def standing(arms: float) -> Placement:
    """A body that stands with its arms lowered by an angle [degrees]."""
    pose = np.zeros((55, 3))
    pose[JOINT_NAMES.index("left_shoulder"), 2] = -np.radians(arms)
    pose[JOINT_NAMES.index("right_shoulder"), 2] = np.radians(arms)
    return Placement.of(pose, np.zeros(3))


def seen(placement: Placement, style: Tshirt) -> Cloud:
    """What a scanner with 1 mm of noise sees of a hung shirt: points from an even spread over its triangles."""
    garment, model = make(style, BODY), fabric_model(FABRIC)
    x = hung(garment, Cloth.of(garment, model.density), BODY, placement, model)
    corners = x[garment.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    random = np.random.default_rng(4)
    area = np.linalg.norm(normals, axis=1)
    face = random.choice(len(area), 5000, p=area / area.sum())
    points = np.einsum("nk,nkc->nc", random.dirichlet(np.ones(3), 5000), corners[face])
    noisy = points + random.normal(0, 1e-3, points.shape)
    return Cloud("made", noisy, normals[face] / area[face, None], np.full(5000, UPPER))


def test_a_shirt_that_is_too_tight_is_widened():
    """Of the same fabric, on another mesh; starting 1.5 cm too tight round the chest and 1.2 cm round the arm."""
    true, placement, model = Tshirt(ease=0.027, sleeve_ease=0.016, edge_length=0.03), standing(60), fabric_model(FABRIC)
    tight = replace(true, ease=0.012, sleeve_ease=0.004)
    found = hung_eases(tight, FIGURE, [placement], [seen(placement, true)], "upper", model, lambda *_: None)
    assert isinstance(found, Tshirt)
    assert tight.ease + 0.004 < found.ease < true.ease + 0.004
    assert tight.sleeve_ease + 0.003 < found.sleeve_ease < true.sleeve_ease + 0.004
    assert (found.length, found.sleeve, found.edge_length) == (true.length, true.sleeve, true.edge_length)


def test_what_an_ease_widens():
    """A shirt's ease moves its trunk out by as much and leaves the sleeves, whose own collects below the arm, twice as
    much there; the leg's ease of trousers moves legs."""
    shirt = Tshirt(edge_length=0.03)
    garment = make(shirt, BODY)
    slopes = widening(shirt, ["ease", "sleeve_ease"], BODY, garment.vertices)
    arm = garment.weights[:, [JOINT_NAMES.index(f"{side}_shoulder") for side in ("left", "right")]].sum(1) > 0.9
    chest = np.abs(garment.vertices[:, 0]) < 0.1
    assert np.median(slopes[chest, 0]) == pytest.approx(1.0, abs=0.1)
    assert np.abs(slopes[arm, 0]).max() < 0.1
    assert np.quantile(slopes[arm, 1], 0.9) == pytest.approx(2.0, abs=0.1)
    assert slopes[arm, 1].min() > -0.1 and np.abs(slopes[chest, 1]).max() < 0.1

    trousers = Trousers(edge_length=0.03)
    garment = make(trousers, BODY)
    slopes = widening(trousers, ["ease", "leg_ease"], BODY, garment.vertices)
    thigh = garment.vertices[:, 1] < np.quantile(garment.vertices[:, 1], 0.5)
    assert np.median(slopes[thigh, 1]) == pytest.approx(1.0, abs=0.1) and np.abs(slopes[thigh, 0]).max() < 0.1


def test_the_step_is_that_of_least_squares():
    """With points exactly on a cloth that is too small by given eases, those eases are told (Geman's weights aside)."""
    random = np.random.default_rng(0)
    slopes = random.normal(size=(50, 3, 2))
    face, share = random.integers(0, 50, 400), random.dirichlet(np.ones(3), 400)
    wanted = np.array([0.002, -0.001])
    height = np.einsum("nj,njk,k->n", share, slopes[face], wanted)
    step = eases_step([Seen(face, share, height)], slopes, np.full(2, 1e3))
    np.testing.assert_allclose(step, wanted, rtol=1e-6)
    kept = eases_step([Seen(face, share, height)], slopes, np.full(2, 1e-9))
    assert np.abs(kept).max() < 1e-9  # nothing is believed against a firm belief


def test_a_scan_that_shows_nothing_near_is_refused():
    placement = standing(60)
    random = np.random.default_rng(0)
    away = Cloud("away", random.normal(0, 0.1, (300, 3)) + 3.0, np.tile([0.0, 0.0, 1.0], (300, 1)), np.full(300, UPPER))
    with pytest.raises(CaphyError, match="does not hang where the scans show one"):
        hung_eases(Tshirt(), FIGURE, [placement], [away], "upper", fabric_model(FABRIC), lambda *_: None)
