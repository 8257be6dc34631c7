"""Edges too short for cloth are drawn together: where remeshing leaves them the rest shape had no area at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from caphy.body.bundled import default_body
from caphy.capture.subject import displaced
from caphy.errors import CaphyError, TooSharp
from caphy.garment import families, topology
from caphy.garment.families import LongSleeve, Tank, Tshirt, make, make_nearest
from caphy.garment.meshing import SHORTEST, collapse_short

STYLE = {  # a cut whose cuffs the remesher leaves with two vertices in one place
    "length": 0.7771201633807795,
    "ease": 0.03464090655621634,
    "flare": 0.014586955245856494,
    "neck_width": 0.03121269027156186,
    "neck_depth": 0.047251909687752294,
    "sleeve": 0.4365878773445606,
    "sleeve_ease": 0.00411313064042957,
    "edge_length": 0.03,
}
TIGHT = {"sleeve": 0.27, "length": 0.7, "ease": 0.012, "sleeve_ease": 0.0, "flare": 0.0}


def grid(count: int):
    """A flat square of ``count`` x ``count`` vertices, edges 1 m, turned up."""
    x, y = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    corner = (x * count + y)[:-1, :-1].ravel()
    a, b, c, d = corner, corner + count, corner + count + 1, corner + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1).astype(float), faces


@pytest.mark.parametrize(
    ("moved", "onto", "there"),
    [
        (12, 17, (2.5, 2.0, 0.0)),  # both inside: to the middle
        (12, 11, (2.0, 1.5, 0.0)),
        (0, 1, (0.0, 0.5, 0.0)),  # along the boundary, at a corner
        (6, 1, (0.0, 1.0, 0.0)),  # from inside onto the boundary, which keeps its place
    ],
)
def test_a_short_edge_is_drawn_together(moved, onto, there):
    vertices, faces = grid(5)
    near = vertices.copy()
    near[moved] = vertices[onto] + 1e-3 * (vertices[moved] - vertices[onto])
    points, kept = collapse_short(near, faces, 0.25)
    assert len(points) == len(vertices) - 1
    assert not topology.check_manifold(kept, len(points))
    mesh = trimesh.Trimesh(points, kept, process=False)
    assert mesh.euler_number == 1 and (mesh.face_normals[:, 2] > 0.999).all()
    middle = 0.5 * (near[moved] + near[onto]) if onto != 1 or moved == 0 else near[onto]
    assert np.linalg.norm(points - middle, axis=1).min() < 1e-12


def test_two_borders_are_not_joined():
    """A strip narrower than the shortest edge may lose faces at its ends, and stays a strip."""
    vertices, faces = grid(5)
    strip = (faces < 10).all(axis=1)
    points, kept = collapse_short(vertices * [0.1, 1.0, 1.0], faces[strip], 0.25)
    assert not topology.check_manifold(kept, len(points)) and len(topology.boundary_loops(kept)) == 1
    assert len(kept) >= strip.sum() - 2 and np.ptp(points[:, 1]) == 4.0


def test_vertices_in_one_place_are_one_vertex():
    vertices, faces = grid(5)
    vertices[13] = vertices[12]
    points, kept = collapse_short(vertices, faces, 0.25)
    assert len(points) == 24 and topology.face_areas(points, kept).min() > 0.2


def test_a_mesh_without_short_edges_stays():
    vertices, faces = grid(4)
    points, kept = collapse_short(vertices, faces, 0.25)
    assert np.array_equal(points, vertices) and np.array_equal(kept, faces)


def test_a_cut_whose_cuff_had_faces_without_area():
    garment = make(Tshirt(**STYLE), default_body("medium"))
    assert garment.rest_areas.min() > 0.05 * np.median(garment.rest_areas)
    ends = garment.vertices[topology.edges(garment.faces)]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).min() > 0.9 * SHORTEST * STYLE["edge_length"]


@pytest.mark.parametrize("edge_length", [0.0205, 0.036])
def test_a_tight_sleeve_is_a_clean_sheet(edge_length):
    """With edges of 36 mm the remesher tears the cuff."""
    garment = make(Tshirt(**TIGHT, edge_length=edge_length), default_body("medium"))
    assert not topology.check_manifold(garment.faces, len(garment.vertices))
    assert len(garment.boundary_loops) == 4
    assert garment.rest_areas.min() > 0.05 * np.median(garment.rest_areas)


def test_a_sheet_that_tears_is_refused():
    """A jersey's sleeves end in a point with such edges."""
    with pytest.raises(TooSharp, match=r"too sharply for edges of 50\.0 mm.*shorter edge_length or for more ease"):
        make(LongSleeve(ease=0.009, sleeve_ease=0.0, flare=0.0, edge_length=0.05), default_body("medium"))


def test_a_cut_too_sharp_for_its_edges_is_made_with_little_shorter_ones():
    wide = Tank(neck_width=0.07, neck_depth=0.09, edge_length=0.05)
    with pytest.raises(TooSharp):
        make(wide, default_body("medium"))
    family, garment = make_nearest(wide, default_body("medium"))
    assert 0.7 * 0.05 <= family.edge_length < 0.05 and replace(family, edge_length=0.05) == wide
    assert garment.provenance["edge_length"] == str(family.edge_length)
    assert garment.rest_areas.min() > 0.05 * np.median(garment.rest_areas)


def test_a_torn_strap_is_refused():
    """One of two straps of 3 mm was lost where they were remeshed."""
    rng, body = np.random.default_rng(20), default_body("medium")
    betas = np.clip(rng.standard_normal(body.shapedirs.shape[2]), -2, 2)
    narrow, _ = displaced(body, betas, rng)
    assert len(make(Tank(neck_width=0.06), narrow).boundary_loops) == 4
    with pytest.raises(TooSharp):
        make(Tank(neck_width=0.07), narrow)


def test_what_can_be_cut_keeps_its_edges():
    family, garment = make_nearest(Tshirt(edge_length=0.04), default_body("medium"))
    assert family == Tshirt(edge_length=0.04)
    assert np.array_equal(garment.vertices, make(family, default_body("medium")).vertices)
    with pytest.raises(CaphyError, match="sleeve must lie between"):
        make_nearest(Tshirt(sleeve=2.0), default_body("medium"))


def test_a_face_that_falls_flat_when_it_is_moved_off_the_body_is_refused(monkeypatch):
    def flattened(*given):
        garment = dress(*given)
        return replace(garment, material=garment.material * (np.arange(len(garment.faces)) != 7)[:, None, None])

    dress = families.dress
    monkeypatch.setattr(families, "dress", flattened)
    with pytest.raises(TooSharp, match=r"edges of 40\.0 mm"):
        make(Tshirt(edge_length=0.04), default_body("medium"))
