"""Pictures against what projective geometry says they must show."""

import sys

import cv2
import numpy as np
import pytest
import trimesh

from caphy.body.bundled import default_body
from caphy.errors import CaphyError
from caphy.report.camera import Camera
from caphy.report.page.colours import nice_ceiling
from caphy.report.render import Shape, contact_sheet, render, vertex_normals, write_png

RED, GREEN, BLUE = (0.9, 0.1, 0.1), (0.1, 0.9, 0.1), (0.1, 0.1, 0.9)


def ball(centre=(0, 0, 0), radius=1.0, colour=RED):
    mesh = trimesh.creation.icosphere(4, radius)
    return Shape(mesh.vertices + np.asarray(centre), mesh.faces, colour)


def covered(image, channel=None):
    """Pixels that are not background, or in which one colour channel dominates."""
    if channel is None:
        return image.min(axis=-1) < 235
    others = np.delete(image.astype(int), channel, axis=-1).max(axis=-1)
    return image[..., channel] > others + 20


def test_a_sphere_covers_the_disc_perspective_gives_it():
    camera = Camera(np.array([0, 0, 5.0]), np.zeros(3), field_of_view=40)
    image = render([ball()], camera, (200, 200))
    tangent = 1 / np.sqrt(5**2 - 1)  # of the cone that touches the sphere
    radius = tangent / np.tan(np.radians(20)) * 100
    assert covered(image).sum() == pytest.approx(np.pi * radius**2, rel=0.02)
    rows, columns = np.nonzero(covered(image))
    assert rows.mean() == pytest.approx(99.5, abs=0.5) and columns.mean() == pytest.approx(99.5, abs=0.5)


@pytest.mark.parametrize(("azimuth", "seen_right"), [(0, "x"), (90, "-z"), (180, "-x"), (270, "z")])
def test_azimuth_goes_round_by_the_left(azimuth, seen_right):
    balls = {"x": (2, 0, 0), "-x": (-2, 0, 0), "z": (0, 0, 2), "-z": (0, 0, -2)}
    shapes = [ball(at, 0.5, BLUE if name == seen_right else RED) for name, at in balls.items()]
    points = np.concatenate([shape.vertices for shape in shapes])
    image = render(shapes, Camera.framing(points, azimuth, 20), (120, 120))
    assert np.nonzero(covered(image, 2))[1].mean() > 80


def test_up_is_up_and_near_hides_far():
    shapes = [ball((0, 2, 0), 0.5, BLUE), ball((0, 0, 0), 1, GREEN), ball((0, 0, -3), 0.9, RED)]
    image = render(shapes, Camera(np.array([0, 0, 12.0]), np.zeros(3)), (120, 120))
    assert np.nonzero(covered(image, 2))[0].mean() < 30
    assert covered(image, 1).sum() > 300 and covered(image, 0).sum() == 0


@pytest.mark.parametrize("size", [(100, 100), (160, 80), (80, 160)])
@pytest.mark.parametrize("elevation", [-20, 0, 60, 90])
def test_framing_holds_everything_closely(size, elevation):
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * (1, 2, 0.5) + (3, 1, 2)
    camera = Camera.framing(points, 30, elevation, aspect=size[0] / size[1])
    right, up, forward = camera.axes()
    offset = points - camera.eye
    slope = np.tan(np.radians(camera.field_of_view) / 2)
    x = offset @ right / (offset @ forward) / slope / max(size[0] / size[1], 1)
    y = offset @ up / (offset @ forward) / slope / max(size[1] / size[0], 1)
    assert 0.75 < max(np.abs(x).max(), np.abs(y).max()) <= 1


def test_vertex_colours_are_interpolated():
    triangle = Shape(
        np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]), np.array([RED, GREEN, BLUE])
    )
    image = render([triangle], Camera(np.array([0, 0, 5.0]), np.zeros(3), 26), (100, 100))
    assert covered(image, 0)[70:, :40].any() and covered(image, 1)[70:, 60:].any() and covered(image, 2)[:40].any()
    middle = image[60, 50].astype(int)
    assert np.ptp(middle) < 60


def test_cloth_is_lit_alike_on_both_sides():
    square = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    shape = Shape(square.vertices, square.faces, GREEN)
    front, back = (render([shape], Camera(np.array([0, 0, z]), np.zeros(3)), (60, 60)) for z in (4.0, -4.0))
    assert covered(front, 1).all()
    np.testing.assert_allclose(front.astype(int), back.astype(int), atol=1)


def test_the_floor_takes_the_shadow():
    shape, camera = ball((0, 1.5, 0), 0.5), Camera(np.array([0, 4.0, 8]), np.array([0, 0.8, 0]), 40)
    plain = render([shape], camera, (120, 120), ground=0.0)
    shaded = render([shape], camera, (120, 120), ground=0.0, shadows=True)
    darker = plain.astype(int).sum(axis=-1) - shaded.astype(int).sum(axis=-1)
    assert darker.min() >= 0 and (darker > 60).sum() > 100


def test_vertex_normals_are_the_sums_of_face_areas():
    body = default_body()
    expected = np.zeros_like(body.v_template)
    for face in body.faces:
        a, b, c = body.v_template[face]
        expected[face] += np.cross(b - a, c - a) / 2
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(body.v_template, body.faces), expected, atol=1e-12)


def test_contact_sheet_and_png(tmp_path):
    images = [np.full((20, 30, 3), value, dtype=np.uint8) for value in (10, 60, 110)]
    assert contact_sheet(images, 2).shape == (40, 60, 3)
    sheet = contact_sheet(images, 2, ["a", "b", "c"])
    assert sheet.shape == (88, 60, 3) and (sheet[:20, 30:] == 60).all() and (sheet[44:64, :30] == 110).all()
    sheet[0, 0] = (255, 0, 0)
    path = write_png(sheet, tmp_path / "new folder" / "sheet.png")
    np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], sheet)
    assert [p.name for p in path.parent.iterdir()] == ["sheet.png"]


def test_what_can_be_put_right_is_said(monkeypatch):
    with pytest.raises(CaphyError, match="at least one mesh"):
        render([])
    broken = ball()
    broken.vertices[3, 1] = np.nan
    with pytest.raises(CaphyError, match="finite"):
        render([broken])
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(CaphyError, match=r"caphy\[render\]"):
        render([ball()])


@pytest.mark.parametrize(
    ("value", "ceiling"),
    [(0.14, "0.15"), (0.028, "0.03"), (0.0011, "0.0015"), (1.0, "1.0"), (16.0, "20.0"), (96.0, "100.0"), (0.0, "1.0")],
)
def test_a_scale_ends_at_a_number_that_is_written_shortly(value, ceiling):
    """It stands beside the colours as it is."""
    assert repr(nice_ceiling(value)) == ceiling
