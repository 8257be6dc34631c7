"""Every family, on two body shapes, meets the criteria of a clean template."""

from __future__ import annotations

from pathlib import Path

import gpytoolbox
import numpy as np
import pytest
import trimesh

import caphy
from caphy.body.bundled import default_body
from caphy.errors import CaphyError
from caphy.garment import topology
from caphy.garment.families import FAMILIES, Tshirt, make
from caphy.garment.template import Garment

OPENINGS = {"tshirt": 4, "longsleeve": 4, "tank": 4, "trousers": 3, "shorts": 3, "skirt": 2}
EVERY = [(family, shape) for family in FAMILIES for shape in ("average", "other")]


def nearest(points, vertices, faces):
    """Signed distance (N,) and nearest face (N,) by gpytoolbox, which knows nothing of our own nearest points."""
    distance, face, _ = gpytoolbox.signed_distance(points, vertices, faces.astype(np.int32))
    return distance, face


@pytest.mark.parametrize(("family", "shape"), EVERY)
class TestQuality:
    def test_one_oriented_manifold_with_its_openings(self, made, family, shape):
        garment, _ = made(family, shape)
        mesh = trimesh.Trimesh(garment.vertices, garment.faces, process=False)
        assert not topology.check_manifold(garment.faces, len(garment.vertices))
        assert mesh.is_winding_consistent and mesh.body_count == 1
        assert len(garment.boundary_loops) == OPENINGS[family]
        # a sphere with k holes has Euler number 2 - k: no handles, no closed-off pockets
        assert mesh.euler_number == 2 - OPENINGS[family]

    def test_faces_look_outwards(self, made, family, shape):
        garment, marks = made(family, shape)
        centres = garment.vertices[garment.faces].mean(axis=1)
        _, face = nearest(centres, marks.vertices, marks.body.faces)
        outward = topology.face_normals(marks.vertices, marks.body.faces)[face]
        agree = (outward * topology.face_normals(garment.vertices, garment.faces)).sum(axis=1)
        assert (agree > 0).mean() > 0.97

    def test_angles(self, made, family, shape):
        garment, _ = made(family, shape)
        mesh = trimesh.Trimesh(garment.vertices, garment.faces, process=False)
        least = np.degrees(mesh.face_angles.min(axis=1))
        assert (least > 20.0).mean() >= 0.99
        assert least.min() > 8.0

    def test_edges_have_the_target_length(self, made, family, shape):
        garment, _ = made(family, shape)
        ends = garment.vertices[topology.edges(garment.faces)]
        length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / FAMILIES[family]().edge_length
        assert 0.9 < np.median(length) < 1.1
        assert length.min() > 0.2 and length.max() < 2.0

    def test_outside_the_body_by_two_millimetres_also_between_vertices(self, made, family, shape):
        garment, marks = made(family, shape)
        edge = garment.vertices[topology.edges(garment.faces)].mean(axis=1)
        points = np.concatenate([garment.vertices, edge, garment.vertices[garment.faces].mean(axis=1)])
        assert nearest(points, marks.vertices, marks.body.faces)[0].min() >= 0.002

    def test_openings_are_smooth(self, made, family, shape):
        garment, _ = made(family, shape)
        for loop in garment.boundary_loops:
            p = garment.vertices[loop]
            step = np.roll(p, -1, axis=0) - p
            unit = step / np.linalg.norm(step, axis=1, keepdims=True)
            turn = np.degrees(np.arccos(np.clip((unit * np.roll(unit, 1, axis=0)).sum(axis=1), -1, 1)))
            # a smooth closed curve turns 360 degrees in all, plus the bends of a neckline; a ragged one far more
            assert turn.sum() < 620 and turn.max() < 75, (loop.size, turn.sum(), turn.max(), p[turn.argmax()])

    def test_symmetric_in_shape(self, made, family, shape):
        garment, _ = made(family, shape)
        distance, _ = nearest(garment.vertices * [-1.0, 1.0, 1.0], garment.vertices, garment.faces)
        assert np.percentile(np.abs(distance), 99) < 0.003

    def test_does_not_cross_itself(self, made, family, shape):
        """No edge pierces a triangle that it does not touch (rays by embree)."""
        garment, _ = made(family, shape)
        mesh = trimesh.Trimesh(garment.vertices, garment.faces, process=False)
        edge = topology.edges(garment.faces)
        start, end = garment.vertices[edge[:, 0]], garment.vertices[edge[:, 1]]
        hit, ray, face = mesh.ray.intersects_location(start, end - start, multiple_hits=True)
        along = ((hit - start[ray]) * (end - start)[ray]).sum(1) / ((end - start)[ray] ** 2).sum(1)
        shares = (garment.faces[face][:, :, None] == edge[ray][:, None, :]).any(axis=(1, 2))
        assert not ((along > 0.01) & (along < 0.99) & ~shares).any()

    def test_rest_metric_is_isometric_and_free_of_folds(self, made, family, shape):
        garment, _ = made(family, shape)
        for k in range(3):
            flat = np.linalg.norm(garment.material[:, k] - garment.material[:, k - 1], axis=1)
            ends = garment.vertices[garment.faces[:, [k, k - 1]]]
            solid = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
            np.testing.assert_allclose(flat, solid, atol=1e-9)
        a, b = garment.material[:, 1] - garment.material[:, 0], garment.material[:, 2] - garment.material[:, 0]
        assert (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).min() > 0

    def test_warp_runs_along_the_garment(self, made, family, shape):
        """The 3-D image of the material's v axis, by inverting each triangle's 2x2 map."""
        garment, marks = made(family, shape)
        corner, flat = garment.vertices[garment.faces], garment.material
        d3 = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2)
        d2 = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=2)
        warp = (d3 @ np.linalg.inv(d2))[:, :, 1]
        centre = corner.mean(axis=1)
        shoulder = marks.joint("left_shoulder")
        sleeve = (np.abs(centre[:, 0]) > shoulder[0] + 0.08) & (centre[:, 1] > marks.armpit - 0.1)
        below = centre[:, 1] < marks.armpit - 0.1
        assert np.percentile(np.abs(warp[below, 1]), 5) > 0.9
        if sleeve.any():
            assert np.percentile(np.abs(warp[sleeve, 0]), 5) > 0.9
        pairs = topology.hinge_faces(garment.faces)
        angle = np.degrees(np.arccos(np.clip(np.abs((warp[pairs[:, 0]] * warp[pairs[:, 1]]).sum(axis=1)), 0, 1)))
        assert np.percentile(angle, 99) < 35  # smooth from face to face, the shoulders included


@pytest.mark.parametrize(("family", "shape"), EVERY)
def test_weights(made, family, shape):
    garment, marks = made(family, shape)
    weights, x = garment.weights, garment.vertices[:, 0]
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    assert (weights >= 0).all() and (weights > 0).sum(axis=1).max() <= 4
    left = [16, 18, 20, 13]
    right = [17, 19, 21, 14]
    assert weights[x > 0.13][:, right].max() == 0 and weights[x < -0.13][:, left].max() == 0
    assert weights[:, 22:].max() == 0  # no cloth hangs on the jaw, the eyes or the fingers
    if family in ("trousers", "shorts"):
        deep = garment.vertices[:, 1] < marks.crotch - 0.16
        assert weights[deep & (x > 0)][:, [2, 5, 8]].max() == 0 and weights[deep & (x < 0)][:, [1, 4, 7]].max() == 0
    ends = topology.edges(garment.faces)
    assert np.abs(weights[ends[:, 0]] - weights[ends[:, 1]]).max() < 0.5


@pytest.mark.parametrize("family", FAMILIES)
def test_regions_and_waistband(made, family):
    garment, marks = made(family)
    x, y, _ = garment.vertices.T
    names = set(garment.regions.tolist())
    if family in ("trousers", "shorts", "skirt"):
        assert {"waist", "hem", "hips", "leg_left", "leg_right"} <= names
        assert (garment.attached > 0.99).sum() > 20
        assert (garment.attached[y < y.max() - 0.06] == 0).all()
        assert (x[garment.region("leg_left")] >= 0).all()
    else:
        assert {"collar", "chest", "back", "belly", "hem"} <= names and not garment.attached.any()
        assert y[garment.region("collar")].min() > marks.armpit - 0.05
    if family in ("tshirt", "longsleeve"):
        assert (x[garment.region("sleeve_left", "cuff_left")] > marks.joint("left_shoulder")[0]).all()
        assert (x[garment.region("sleeve_right", "cuff_right")] < -marks.joint("left_shoulder")[0]).all()


def test_edge_length_sets_the_vertex_count():
    garment = make(Tshirt(edge_length=0.0148), default_body("medium"))
    assert 0.9 < len(garment.vertices) / 4424 < 1.1


def test_lengths_are_what_was_asked_for():
    body = default_body("medium")
    garment = make(Tshirt(sleeve=0.25, length=0.6, edge_length=0.03), body)
    shoulder, neck = body.joints[16], body.joints[12]
    assert garment.vertices[:, 0].max() == pytest.approx(shoulder[0] + 0.25, abs=0.004)
    assert garment.vertices[:, 1].min() == pytest.approx(neck[1] - 0.6, abs=0.004)


@pytest.mark.parametrize(("option", "value"), [("sleeve", 2.0), ("length", 0.05), ("edge_length", 0.2)])
def test_options_that_do_not_fit_the_body_are_refused_with_their_range(option, value):
    with pytest.raises(CaphyError, match=rf"{option} must lie between .* got {value:.3f} m"):
        make(Tshirt(**{option: value}), default_body("medium"))


def test_default_pair_is_layered():
    """The bundled T-shirt hangs over the bundled trousers' waistband, outside them by more than they need."""
    folder = Path(caphy.__file__).parent / "data" / "garments"
    shirt, trousers = Garment.load(folder / "tshirt.npz"), Garment.load(folder / "trousers.npz")
    assert 2000 < len(shirt.vertices) < 2800 and 2000 < len(trousers.vertices) < 2800
    overlap = shirt.vertices[:, 1] < trousers.vertices[:, 1].max() - 0.01
    assert overlap.sum() > 200
    assert np.all(shirt.layer_thickness[overlap] >= 0.008)
    assert np.all((trousers.layer_thickness >= 0.002) & (trousers.layer_thickness <= 0.003))
    points = shirt.vertices[overlap]
    distance, face = nearest(points, trousers.vertices, trousers.faces)
    normal = topology.face_normals(trousers.vertices, trousers.faces)[face]
    outward = ((points - trousers.vertices[trousers.faces[face, 0]]) * normal).sum(axis=1)
    assert np.abs(distance).min() > 0.006 and (outward > 0).all()
