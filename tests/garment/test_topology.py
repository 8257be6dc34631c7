"""Connectivity against plain loops and other packages."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from caphy.garment import topology


@pytest.fixture(scope="module")
def cup():
    """An icosphere without its top: one boundary loop."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    kept = faces[vertices[faces][..., 1].max(axis=1) < 0.2]
    used, flat = np.unique(kept, return_inverse=True)
    return vertices[used], flat.reshape(-1, 3)


def hinges_by_loop(faces):
    """Dictionary from undirected edge to its (start, end, opposite, face) records, in plain Python."""
    found = defaultdict(list)
    for f, (a, b, c) in enumerate(faces.tolist()):
        for start, end, opposite in ((a, b, c), (b, c, a), (c, a, b)):
            found[min(start, end), max(start, end)].append((start, end, opposite, f))
    return found


def test_hinges_equal_a_plain_loop(cup):
    _, faces = cup
    expected = {key: rec for key, rec in hinges_by_loop(faces).items() if len(rec) == 2}
    got, sides = topology.hinges(faces), topology.hinge_faces(faces)
    assert len(got) == len(expected)
    for (a, b, c, d), (f, g) in zip(got.tolist(), sides.tolist(), strict=True):
        first, second = sorted(expected[min(a, b), max(a, b)], key=lambda r: r[:2] != (a, b))
        assert first == (a, b, c, f) and second == (b, a, d, g)


def test_edges_equal_trimesh(cup):
    vertices, faces = cup
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    np.testing.assert_array_equal(topology.edges(faces), np.unique(np.sort(mesh.edges_unique, axis=1), axis=0))


def test_boundary_loop_is_the_set_of_one_sided_edges_in_order(cup):
    _, faces = cup
    one_sided = {rec[0][:2] for rec in hinges_by_loop(faces).values() if len(rec) == 1}
    (loop,) = topology.boundary_loops(faces)
    assert set(zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)) == one_sided


def test_areas_normals_angles_equal_trimesh(cup):
    vertices, faces = cup
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    np.testing.assert_allclose(topology.face_areas(vertices, faces), mesh.area_faces, rtol=1e-12)
    np.testing.assert_allclose(topology.face_normals(vertices, faces), mesh.face_normals, atol=1e-12)
    np.testing.assert_allclose(topology.face_angles(vertices, faces), mesh.face_angles, atol=1e-7)


def test_masses_sum_to_density_times_area_and_are_lumped_thirds(cup):
    vertices, faces = cup
    areas = topology.face_areas(vertices, faces)
    mass = topology.vertex_masses(areas, faces, len(vertices), 0.2)
    assert mass.sum() == pytest.approx(0.2 * areas.sum())
    assert mass[7] == pytest.approx(0.2 * sum(a for a, f in zip(areas, faces, strict=True) if 7 in f) / 3)


def test_connected_labels_equal_scipy():
    rng = np.random.default_rng(3)
    pairs = rng.integers(0, 400, (260, 2))
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(400, 400))
    _, expected = connected_components(graph, directed=False)
    got = topology.connected_labels(400, pairs)
    assert len(np.unique(got)) == len(np.unique(expected))
    assert len(np.unique(np.stack([got, expected]), axis=1).T) == len(np.unique(got))


def test_components_are_sorted_by_size(cup):
    _, faces = cup
    two = np.concatenate([faces[:5] + 1000, faces])
    big, *rest = topology.components(two)
    assert len(big) == len(faces) and sum(map(len, rest)) == 5


@pytest.mark.parametrize(
    ("faces", "kind"),
    [
        ([[0, 1, 2], [1, 0, 3], [0, 1, 4]], "more than two faces"),
        ([[0, 1, 2], [0, 1, 3]], "opposite senses"),
        ([[0, 1, 2], [0, 3, 4]], "separate fans"),
        ([[0, 1, 2], [2, 1, 1]], "repeat a vertex"),
    ],
)
def test_each_defect_is_named(faces, kind):
    defects = topology.check_manifold(np.array(faces))
    assert defects and kind in defects.describe()


def test_a_clean_mesh_has_no_defects_and_unused_vertices_are_seen(cup):
    vertices, faces = cup
    assert not topology.check_manifold(faces, len(vertices))
    assert topology.check_manifold(faces, len(vertices) + 1).unused.tolist() == [len(vertices)]


def test_hinges_refuse_a_non_manifold_mesh():
    with pytest.raises(ValueError, match="more than two faces"):
        topology.hinges(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))


def test_winding_is_repaired_by_turning_the_minority(cup):
    _, faces = cup
    rng = np.random.default_rng(0)
    turned = rng.random(len(faces)) < 0.3
    broken = np.where(turned[:, None], faces[:, ::-1], faces)
    np.testing.assert_array_equal(topology.consistent_winding(broken), turned)


def test_of_two_halves_wound_against_each_other_one_is_turned(cup):
    """As a mirrored half leaves it that was not flipped."""
    _, faces = cup
    faces = faces[: len(faces) // 2 * 2]
    half = np.arange(len(faces)) < len(faces) // 2
    turned = topology.consistent_winding(np.where(half[:, None], faces[:, ::-1], faces))
    assert np.array_equal(turned, half) or np.array_equal(turned, ~half)


def test_a_face_as_flat_as_rounding_has_no_area():
    """A vertex that six decimals put amid a side leaves a face of 5e-7 m by 2 cm, above a millionth of others."""
    flat = np.array([[[0.0, 0.0], [0.02, 0.0], [0.0, 0.02]], [[0.0, 0.0], [0.02, 0.0], [0.01, 5e-7]]])
    assert topology.without_area(flat).tolist() == [1]
    flat[1, 2, 1] = 1e-4
    assert topology.without_area(flat).tolist() == []
