"""Nearest points and signed distance against exhaustive search, the winding number and finite differences."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree

from caphy.body.bundled import default_body
from caphy.body.grouped import GroupedClouds, GroupedSurface
from caphy.body.surface import NearestPoints, Surface, nearest_on_surface
from caphy.errors import CaphyError


def winding_number(points, vertices, faces):
    """1 inside, 0 outside: solid angles of all triangles (Van Oosterom and Strackee 1983)."""
    corners = vertices[faces][None] - points[:, None, None]
    lengths = np.linalg.norm(corners, axis=-1)
    a, b, c = corners[:, :, 0], corners[:, :, 1], corners[:, :, 2]
    la, lb, lc = lengths[..., 0], lengths[..., 1], lengths[..., 2]
    determinant = np.sum(a * np.cross(b, c), axis=-1)
    dots = [np.sum(x * y, axis=-1) for x, y in ((a, b), (b, c), (c, a))]
    return np.arctan2(determinant, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb).sum(axis=1) / (2 * np.pi)


def body_and_points(count=400, spread=0.03):
    body = default_body()
    random = np.random.default_rng(0)
    poses = random.normal(size=(1, 55, 3)) * 0.15
    vertices = body.pose(poses)[0]
    chosen = vertices[random.integers(0, len(vertices), count)]
    return vertices, body.faces, chosen + random.normal(size=(count, 3)) * spread


def nearest_in_groups(points, vertices, faces):
    """Of one frame, in double precision, as :func:`nearest_on_surface`."""
    groups = GroupedSurface(Surface.of(faces, vertices))
    found = groups.nearest(torch.from_numpy(points)[None], torch.from_numpy(np.array(vertices))[None])
    return NearestPoints(*(field[0].numpy() for field in found))


both_ways = pytest.mark.parametrize("nearest", [nearest_on_surface, nearest_in_groups], ids=["tree", "groups"])

CUBE = trimesh.creation.box((2, 2, 2))
SPIKE = trimesh.Trimesh(
    [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.03, 0.03, 4]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
)


@both_ways
@pytest.mark.parametrize("spread", [0.005, 0.05, 0.5])
def test_body_against_exhaustive_search(spread, nearest):
    vertices, faces, points = body_and_points(spread=spread)
    found = nearest(points, vertices, faces)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, points)
    np.testing.assert_allclose(np.abs(found.distance), distance, atol=1e-12)
    corners = vertices[faces[found.face]]
    np.testing.assert_allclose(np.einsum("nk,nkc->nc", found.barycentric, corners), found.point, atol=1e-14)
    np.testing.assert_allclose(found.point + found.distance[:, None] * found.normal, points, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, atol=1e-12)
    assert found.barycentric.min() >= 0


def test_on_edges_and_corners_groups_have_the_tree_s_normals():
    """Of places on the surface, whose weights are some rounding off zero."""
    mesh = trimesh.creation.icosphere(3)
    vertices = mesh.vertices * (1 + 0.3 * np.sin(4 * mesh.vertices[:, [0]])) + [5, 0, -3]
    middles = vertices[mesh.edges_unique].mean(axis=1)
    points = np.concatenate([vertices, middles])
    found, wanted = nearest_in_groups(points, vertices, mesh.faces), nearest_on_surface(points, vertices, mesh.faces)
    np.testing.assert_allclose(found.normal, wanted.normal, atol=1e-9)


@both_ways
def test_sign_of_the_resting_body_is_its_winding_number(nearest):
    body = default_body()
    random = np.random.default_rng(1)
    points = body.v_template[random.integers(0, len(body.v_template), 400)] + random.normal(size=(400, 3)) * 0.02
    inside = winding_number(points, body.v_template, body.faces) > 0.5
    np.testing.assert_array_equal(nearest(points, body.v_template, body.faces).distance < 0, inside)
    assert 100 < inside.sum() < 300


@both_ways
@pytest.mark.parametrize("mesh", [CUBE, SPIKE], ids=["cube", "spike"])
def test_signs_beside_sharp_edges_and_corners(mesh, nearest):
    random = np.random.default_rng(2)
    corners = np.repeat(mesh.vertices, 200, axis=0)
    points = corners + random.normal(size=corners.shape) * 0.05
    inside = winding_number(points, mesh.vertices, mesh.faces) > 0.5
    np.testing.assert_array_equal(nearest(points, mesh.vertices, mesh.faces).distance < 0, inside)


@both_ways
def test_cube_closed_form(nearest):
    points = np.array(
        [[0, 0, 3], [3, 3, 0], [2, 2, 2], [0.5, 0, 0.9], [1, 0.2, 0.1], [1, 1, 0], [1, 1, 1]], dtype=float
    )
    found = nearest(points, CUBE.vertices, CUBE.faces)
    s = np.sqrt(0.5)
    np.testing.assert_allclose(found.distance, [2, 2 * np.sqrt(2), np.sqrt(3), -0.1, 0, 0, 0], atol=1e-12)
    normals = [[0, 0, 1], [s, s, 0], [3**-0.5] * 3, [0, 0, 1], [1, 0, 0], [s, s, 0], [3**-0.5] * 3]
    np.testing.assert_allclose(found.normal, normals, atol=1e-12)


def test_normal_is_the_gradient_of_the_distance():
    vertices, faces, points = body_and_points(spread=0.02)
    surface = Surface.of(faces, vertices)
    found = surface.nearest(points, vertices)
    step = 1e-7
    gradient = np.stack(
        [
            (surface.nearest(points + d, vertices).distance - surface.nearest(points - d, vertices).distance)
            / (2 * step)
            for d in step * np.eye(3)
        ],
        axis=-1,
    )
    error = np.linalg.norm(gradient - found.normal, axis=1)
    assert np.mean(error < 1e-6) > 0.99  # a few points lie on the medial axis, where there is no gradient


def test_a_surface_follows_its_vertices_and_guesses_change_nothing():
    vertices, faces, points = body_and_points()
    surface = Surface.of(faces, default_body().v_template)  # grouped in another pose
    expected = nearest_on_surface(points, vertices, faces)
    for guess in (None, expected.face, np.zeros(len(points), dtype=int)):
        np.testing.assert_allclose(surface.nearest(points, vertices, guess).distance, expected.distance, atol=1e-14)


def test_degenerate_triangles_do_no_harm():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [1, 0, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 4, 1]])
    found = nearest_on_surface(np.array([[1.5, -1.0, 0.0], [0.2, 0.2, 0.5], [1.5, 0, 0]]), vertices, faces)
    np.testing.assert_allclose(np.abs(found.distance), [1, 0.5, 0], atol=1e-14)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: nearest_on_surface(np.full((1, 3), np.nan), CUBE.vertices, CUBE.faces), "finite"),
        (lambda: nearest_on_surface(np.zeros((1, 3)), CUBE.vertices, CUBE.faces + 1), "must index 8 vertices"),
        (lambda: nearest_on_surface(np.zeros((1, 3)), CUBE.vertices, np.zeros((0, 3))), "needs triangles"),
        (lambda: nearest_on_surface(np.zeros((1, 3)), CUBE.vertices, np.zeros((2, 4))), "needs triangles"),
    ],
)
def test_wrong_input_is_refused(call, message):
    with pytest.raises(CaphyError, match=message):
        call()


@pytest.mark.parametrize("corners", [(0, 1, 1), (1, 0, 1), (1, 1, 0), (0, 0, 0), (2, 0, 1)])
def test_faces_without_area_change_nothing(corners):
    """A cube whose edges carry such faces: two corners in one, all in one, three in a line."""
    ends = np.array([CUBE.vertices[CUBE.edges_unique[:, 0]], CUBE.vertices[CUBE.edges_unique[:, 1]]])
    flat = np.concatenate([ends, ends.mean(axis=0, keepdims=True)])[list(corners)].transpose(1, 0, 2)
    vertices = np.concatenate([flat.reshape(-1, 3), CUBE.vertices])
    faces = np.concatenate([np.arange(3 * len(flat)).reshape(-1, 3), CUBE.faces + 3 * len(flat)])
    points = np.random.default_rng(0).uniform(-2, 2, (2000, 3))
    wanted = nearest_on_surface(points, CUBE.vertices, CUBE.faces)
    found = nearest_on_surface(points, vertices, faces)
    np.testing.assert_allclose(np.abs(found.distance), np.abs(wanted.distance), atol=1e-12)
    np.testing.assert_allclose(found.point, wanted.point, atol=1e-12)


def test_groups_are_exact_in_many_frames_and_far_from_the_origin():
    """Single precision, frames in different poses, each in a place of its own; points on the skin among them."""
    body, random = default_body(), np.random.default_rng(3)
    away = np.array([[0, 0, 0], [30, 1, -40], [0, 5, 0]])
    vertices = body.pose(0.3 * random.normal(size=(3, 55, 3)), away)
    chosen = random.integers(0, len(body.v_template), (3, 500))
    points = np.stack([v[c] for v, c in zip(vertices, chosen, strict=True)])
    points[:, 100:] += random.normal(size=(3, 400, 3)) * np.linspace(0.001, 0.2, 400)[:, None]
    groups = GroupedSurface(Surface.of(body.faces, body.v_template))
    found = groups.nearest(torch.from_numpy(points).float(), torch.from_numpy(vertices).float())
    for frame in range(3):
        exact = nearest_on_surface(points[frame], vertices[frame], body.faces)
        close = 1e-6 if frame != 1 else 1e-5  # what single precision knows of a place 50 m away
        np.testing.assert_allclose(found.distance[frame], exact.distance, atol=close)
        off = np.abs(exact.distance) > 1e-3
        np.testing.assert_allclose(found.normal[frame][off], exact.normal[off], atol=0.02)
    assert (found.distance < -0.001).sum() > 200 and (found.distance.abs() < 1e-6).sum() > 50


def test_of_equally_near_faces_groups_tell_the_same_one_every_time():
    middle, ends = torch.zeros(1, 50, 3, dtype=torch.float64), torch.from_numpy(np.array(CUBE.vertices))[None]
    faces = GroupedSurface(Surface.of(CUBE.faces, CUBE.vertices)).nearest(middle, ends).face
    assert len(faces.unique()) == 1


def test_clouds_in_groups_against_a_tree():
    """Clouds of different sizes, one of one point and one of none, each asked in an order of its own."""
    random = np.random.default_rng(4)
    clouds = [random.normal(size=(size, 3)) for size in (3000, 1, 0, 37)]
    points, order = random.normal(size=(5, 60, 3)), [3, 0, 2, 1, 0]
    distance, nearest = GroupedClouds(clouds).nearest(torch.from_numpy(points), torch.tensor(order))
    for row, cloud in enumerate(order):
        if len(clouds[cloud]):
            apart, place = KDTree(clouds[cloud]).query(points[row])
            np.testing.assert_allclose(distance[row], apart, atol=1e-6)
            np.testing.assert_allclose(nearest[row], clouds[cloud][place], atol=1e-6)
        else:
            assert torch.isinf(distance[row]).all()
