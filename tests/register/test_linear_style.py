"""A linear style basis whose coefficients are known."""

from __future__ import annotations

import numpy as np
import pytest
from dressed_scans import GARMENTS, Subject, look

from caphy.body.bundled import default_body
from caphy.errors import CaphyError
from caphy.garment.families import Tshirt, default_rise, make
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.register.articulation import Figure
from caphy.register.chamfer import Target
from caphy.register.cloud import Cloud
from caphy.register.linear_style import LinearStyle, choose_linear, linear_garment
from caphy.register.starts import plain_poses


@pytest.fixture
def basis(tmp_path):
    """Trousers that can be longer (first coefficient) and wider (second)."""
    garment = Garment.load(GARMENTS / "trousers.npz")
    x, y, _ = garment.vertices.T
    below = np.clip(0.0 - y, 0, None)
    longer = np.stack([0 * y, -0.10 * below / below.max(), 0 * y], axis=1)
    middle = np.sign(x) * 0.11
    wider = 0.02 * (below > 0)[:, None] * np.stack([np.sign(x - middle), 0 * x, 0 * x], axis=1)
    path = tmp_path / "trousers_basis.npz"
    np.savez(path, mean=garment.vertices, components=np.stack([longer, wider]), faces=garment.faces)
    return path


def test_coefficients_of_a_basis_come_back(basis):
    style, body = LinearStyle.load(basis), default_body()
    true = np.array([-1.2, 0.4])
    worn = Garment(**{**vars(Garment.load(GARMENTS / "trousers.npz")), "vertices": style.vertices(true)})
    person = Subject(body, np.zeros(10), np.zeros_like(body.v_template), [worn])
    place = plain_poses()[1]
    sight = look(person, place.pose, place.transl, 0, 6000)
    cloud = Cloud("scan", sight.points, sight.normals, np.where(sight.labels == 1, 2, sight.labels))
    figure = Figure.of(body)
    choice = choose_linear(style, figure, [Target.of(cloud, figure.placed(place), "lower")], count=120)
    assert abs(choice.coefficients[0] - true[0]) < 0.15  # 1.5 cm of leg
    garment = linear_garment(style, choice, figure, "lower")
    np.testing.assert_allclose(garment.vertices, style.vertices(choice.coefficients))
    assert garment.attached.max() == 1.0


def test_a_waistband_under_a_long_shirt_is_where_it_usually_is():
    """Of a basis that only knows how high the waistband is; hidden cloth lies far from what is seen of it."""
    body, trousers = default_body(), Garment.load(GARMENTS / "trousers.npz")
    marks = Landmarks.of(body)
    above = np.clip((trousers.vertices[:, 1] - marks.crotch) / default_rise(marks), 0, None)
    higher = 0.1 * above[:, None] * [0, 1, 0]
    style = LinearStyle("rise", trousers.vertices, higher[None], np.ones(1), trousers.faces)
    shirt = make(Tshirt(length=marks.joint("neck")[1] - marks.crotch + 0.05, layer_thickness=0.013), body)
    person, place = Subject(body, np.zeros(10), np.zeros_like(body.v_template), [shirt, trousers]), plain_poses()[1]
    sight, figure = look(person, place.pose, place.transl, 0, 12000), Figure.of(body)
    cloud = Cloud("scan", sight.points, sight.normals, sight.labels)
    choice = choose_linear(style, figure, [Target.of(cloud, figure.placed(place), "lower")], count=60)
    assert abs(choice.coefficients[0]) < 0.15  # 1.5 cm of rise


def test_a_damaged_basis_says_what_it_needs(basis, tmp_path):
    arrays = dict(np.load(basis))
    damaged = tmp_path / "bad.npz"
    np.savez(damaged, mean=arrays["mean"], faces=arrays["faces"])
    with pytest.raises(CaphyError, match=r"bad\.npz.*components missing"):
        LinearStyle.load(damaged)
    np.savez(damaged, **{**arrays, "components": arrays["components"].transpose(1, 0, 2)})
    with pytest.raises(CaphyError, match="coefficient, vertex, axis"):
        LinearStyle.load(damaged)
    np.savez(damaged, **{**arrays, "faces": arrays["faces"] + 10**6})
    with pytest.raises(CaphyError, match="faces"):
        LinearStyle.load(damaged)


@pytest.mark.parametrize(
    ("key", "spoilt", "told"),
    [
        ("deviations", lambda _: np.array([1.0, 0.0]), r"positive, got 0; leave out"),
        ("deviations", lambda _: np.array([1.0, -2.0]), r"positive, got -2; leave out"),
        ("deviations", lambda _: np.array(1.0), r"an array of numbers, got float64 of shape \(\)"),
        ("components", lambda given: given[:0], r"finite and of shape \(1, \d+, 3\), got \(0,"),
        ("components", lambda given: given.astype(str), r"an array of numbers, got <U32"),
        ("mean", lambda given: given.astype(str), r"an array of numbers, got <U32 .* as floats"),
        ("mean", lambda given: given + 1j, r"an array of numbers, got complex128"),
        ("faces", lambda given: given.astype(str), r"an array of numbers, got <U11 .* as integers"),
        ("faces", lambda given: given[:0], r"triangles \(F, 3\), one at least, .* shape \(0, 3\)"),
        ("faces", lambda given: given + 0.5, r"triangles .* of whole numbers .* got float64 .* from 0\.5 to"),
        ("faces", lambda given: np.where(given, given, np.nan), r"triangles .* of whole numbers .* from nan"),
        ("faces", lambda given: given + 1, r"triangles .* from 1 to \d+; as of an OBJ they count from 1: subtract 1"),
    ],
)
def test_what_is_no_basis_is_refused_in_words(basis, tmp_path, key, spoilt, told):
    arrays = {"deviations": np.ones(2), **np.load(basis)}
    np.savez(tmp_path / "bad.npz", **{**arrays, key: spoilt(arrays[key])})
    with pytest.raises(CaphyError, match=rf"bad\.npz: {key} must be {told}"):
        LinearStyle.load(tmp_path / "bad.npz")


def test_whole_floats_are_faces_too(basis, tmp_path):
    arrays = dict(np.load(basis))
    np.savez(tmp_path / "floats.npz", **{**arrays, "faces": arrays["faces"].astype(float)})
    faces = LinearStyle.load(tmp_path / "floats.npz").faces
    assert faces.dtype == np.int32 and (faces == arrays["faces"]).all()
