"""Eases and lengths of a garment, told by hanging it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from dressed_scans import sampled, visible

from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.effects.cloth import Cloth
from caphy.effects.presets import fabric_model
from caphy.errors import CaphyError
from caphy.garment.families import Trousers, Tshirt, make
from caphy.garment.topology import face_areas
from caphy.register import hanging
from caphy.register.articulation import Figure, Placement
from caphy.register.chamfer import Target
from caphy.register.cloud import Cloud
from caphy.register.girth import Sheet
from caphy.register.hanging import hung, hung_style, widening
from caphy.report.render import vertex_normals
from caphy.scan.scan import BODY as SKIN
from caphy.scan.scan import UPPER, Scan

BODY = default_body()
FIGURE = Figure.of(BODY)
FABRIC, ANOTHER = "gray-interlock", "camel-ponte-roma"


def standing(arms: float) -> Placement:
    """A body that stands with its arms lowered by an angle [degrees]."""
    pose = np.zeros((55, 3))
    pose[JOINT_NAMES.index("left_shoulder"), 2] = -np.radians(arms)
    pose[JOINT_NAMES.index("right_shoulder"), 2] = np.radians(arms)
    return Placement.of(pose, np.zeros(3))


def seen(placement: Placement, style: Tshirt, fabric: str) -> tuple[Target, Sheet]:
    """What a scanner with 1 mm of noise sees of a hung shirt and of the skin beside it; its triangles cut in sixteen,
    edges of 8 mm."""
    garment, model, placed = make(style, BODY), fabric_model(fabric), FIGURE.placed(placement)
    x, rng = hung(garment, Cloth.of(garment, model.density), BODY, placement, model), np.random.default_rng(4)
    meshes = [(placed.vertices, BODY.faces), (x, garment.faces)]
    points, normals, which = sampled(meshes, rng, 90_000)
    kept = visible(points, normals, meshes)
    points, labels = points + rng.normal(0, 1e-3, points.shape), np.array([SKIN, UPPER])[which]
    mesh = trimesh.Trimesh(x, garment.faces, process=False).subdivide().subdivide()
    noisy = mesh.vertices + rng.normal(0, 1e-3, mesh.vertices.shape)
    scan = Scan("made", noisy, np.asarray(mesh.faces, np.int32), labels=np.full(len(noisy), UPPER, np.uint8))
    cloud = Cloud("made", points[kept], normals[kept], labels[kept])
    return Target.of(cloud, placed, "upper"), Sheet.of(scan, "upper")


def areas(style: Tshirt) -> tuple[float, float]:
    """Area [m^2] of a shirt's trunk and of its sleeves, told by the joint that each face follows most."""
    garment = make(style, BODY)
    joint, area = garment.weights[garment.faces].sum(axis=1).argmax(axis=1), face_areas(garment.vertices, garment.faces)
    sleeves = np.isin(joint, [JOINT_NAMES.index(f"{side}_shoulder") for side in ("left", "right")])
    return area[~sleeves].sum(), area[sleeves].sum()


def test_a_shirt_that_is_wider_and_longer_is_widened_and_lengthened(monkeypatch):
    """Of a fabric that the fit does not know, on another mesh; 1.5 cm wider at the chest and 1.2 at the arm than the
    usual ones that it begins with, whatever it is given, with a trunk 4 cm longer and sleeves 3 cm shorter than given.
    Three hangings of four are enough for that."""
    monkeypatch.setattr(hanging, "ROUNDS", 3)
    monkeypatch.setattr(hanging, "AVERAGED", 2)
    usual, model = Tshirt(length=0.62, sleeve=0.18, edge_length=0.03), fabric_model(FABRIC)
    true = replace(usual, ease=0.040, sleeve_ease=0.028)
    target, sheet = seen(standing(30), true, ANOTHER)
    given = replace(true, ease=0.002, sleeve_ease=0.0, flare=0.2, length=0.58, sleeve=0.21)
    found = hung_style(given, FIGURE, [target], [sheet], model, lambda *_: None)
    assert isinstance(found, Tshirt)
    short, wide = (np.array(areas(style)) / areas(true) - 1 for style in (usual, found))
    assert (short < -0.05).all()
    assert np.abs(wide[0]) < 0.03 and np.abs(wide[1]) < 0.04
    # ease and flare make up for each other in all of the trunk but the chest, so each is known less than the girth
    assert usual.ease + 0.005 < found.ease < true.ease + 0.01
    assert usual.sleeve_ease + 0.004 < found.sleeve_ease < true.sleeve_ease + 0.005
    assert (found.length, found.sleeve) == pytest.approx((0.62, 0.18), abs=0.01)
    assert found.edge_length == true.edge_length


def test_what_an_ease_widens():
    """A shirt's ease moves its trunk out by as much and leaves the sleeves, whose own collects below the arm, twice as
    much there; the leg's ease of trousers moves legs."""
    shirt = Tshirt(edge_length=0.03)
    garment = make(shirt, BODY)
    slopes = widening(shirt, ["ease", "sleeve_ease"], BODY, garment.vertices)
    arm = garment.weights[:, [JOINT_NAMES.index(f"{side}_shoulder") for side in ("left", "right")]].sum(1) > 0.9
    under = arm & (vertex_normals(garment.vertices, garment.faces)[:, 1] < -0.9)
    chest = np.abs(garment.vertices[:, 0]) < 0.1
    assert np.median(slopes[chest, 0]) == pytest.approx(1.0, abs=0.1)
    assert np.abs(slopes[arm, 0]).max() < 0.1
    assert np.median(slopes[under, 1]) == pytest.approx(2.0, abs=0.05)
    assert slopes[arm, 1].min() > -0.1 and np.abs(slopes[chest, 1]).max() < 0.1

    trousers = Trousers(edge_length=0.03)
    garment = make(trousers, BODY)
    slopes = widening(trousers, ["ease", "leg_ease"], BODY, garment.vertices)
    thigh = garment.vertices[:, 1] < np.quantile(garment.vertices[:, 1], 0.5)
    assert np.median(slopes[thigh, 1]) == pytest.approx(1.0, abs=0.1) and np.abs(slopes[thigh, 0]).max() < 0.1


def test_a_scan_that_shows_nothing_near_is_refused():
    far, placed = Sheet(BODY.v_template + 3.0, BODY.faces), FIGURE.placed(standing(60))
    skin = placed.vertices[::7]
    cloud = Cloud("far", skin, skin, np.full(len(skin), UPPER))
    target = Target.of(cloud, placed, "upper")
    with pytest.raises(CaphyError, match="does not hang where the scans show one"):
        hung_style(Tshirt(), FIGURE, [target], [far], fabric_model(FABRIC), lambda *_: None)
