"""A user's own meshes: what is read, what is refused and how, and whose rest metric is used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from caphy.body.bundled import default_body
from caphy.cli import main
from caphy.commands import garment as command
from caphy.errors import CaphyError
from caphy.garment import panels
from caphy.garment.families import FAMILIES, make
from caphy.garment.from_mesh import garment_from_mesh, rest_metric
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.garment.usermesh import UserMesh, clean_mesh, read_mesh


def write_obj(path, vertices, faces, uv=None):
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [] if uv is None else [f"vt {u} {v}" for u, v in uv]
    lines += ["f " + " ".join(f"{i + 1}" if uv is None else f"{i + 1}/{i + 1}" for i in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def marks():
    return Landmarks.of(default_body("medium"))


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_a_clean_mesh_passes_in_every_format(strip, tmp_path, suffix):
    vertices, faces = strip
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / f"strip{suffix}")
    mesh = clean_mesh(read_mesh(tmp_path / f"strip{suffix}"))
    assert mesh.vertices.shape == vertices.shape and mesh.faces.shape == faces.shape
    got, want = (np.sort(v[f].mean(axis=1), axis=0) for v, f in ((mesh.vertices, mesh.faces), strip))
    np.testing.assert_allclose(got, want, atol=1e-6)


def test_obj_with_negative_indices_and_normals(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf -3//1 -2//1 -1//1\n")
    np.testing.assert_array_equal(clean_mesh(read_mesh(tmp_path / "a.obj")).faces, [[0, 1, 2]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nv 1 0\nf 1 2 2\n", "three coordinates"),
        ("v 0 0 0\nv 1 0 x\n", r"line 2: cannot be read as OBJ"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "refers to vertex 9, but there are 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "one before the first vertex, .* counted from 1"),
        ("v 0 0 0\n", "must contain faces"),
        ("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "vertex 1 is not"),
    ],
)
def test_damaged_obj(tmp_path, text, message):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(CaphyError, match=message):
        read_mesh(tmp_path / "a.obj")


def test_missing_and_foreign_files(tmp_path):
    (tmp_path / "a.fbx").write_text("x")
    with pytest.raises(CaphyError, match=r"must be one of \.obj"):
        read_mesh(tmp_path / "a.fbx")
    with pytest.raises(CaphyError, match="no such file"):
        read_mesh(tmp_path / "b.obj")
    (tmp_path / "c.glb").write_bytes(b"junk")
    with pytest.raises(CaphyError, match="cannot be read as GLB"):
        read_mesh(tmp_path / "c.glb")


def test_wrong_unit_names_the_right_scale(strip, tmp_path):
    vertices, faces = strip
    raw = read_mesh(write_obj(tmp_path / "cm.obj", vertices * 100, faces))
    with pytest.raises(CaphyError, match=r"got 80 m .*--scale 0\.01 \(centimetres\)"):
        clean_mesh(raw)
    assert np.ptp(clean_mesh(raw, scale=0.01).vertices, axis=0).max() == pytest.approx(0.8)


def test_lying_mesh_names_the_up_axis(strip, tmp_path):
    vertices, faces = strip
    shirt = np.concatenate([vertices, vertices + np.array([0, 0, 0.1])])  # 0.1 m thick, so that it has a lying side
    raw = read_mesh(write_obj(tmp_path / "z.obj", shirt[:, [0, 2, 1]] * [1, -1, 1], [*faces.tolist(), [45, 46, 51]]))
    with pytest.raises(CaphyError, match="--component"):
        clean_mesh(raw)
    with pytest.raises(CaphyError, match="pass --up z"):
        clean_mesh(raw, component="0")
    height = np.ptp(clean_mesh(raw, component="0", up="z").vertices, axis=0)
    np.testing.assert_allclose(height, [0.4, 0.8, 0.0], atol=1e-12)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_up_axes_are_proper_rotations(up):
    from caphy.garment.usermesh import upright

    turn = upright(np.eye(3), up)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    np.testing.assert_allclose(upright(axis[None], up)[0], [0, 1, 0], atol=1e-12)


def test_non_manifold_and_winding(strip, tmp_path):
    vertices, faces = strip
    fin = [*faces.tolist(), [int(faces[10][0]), int(faces[10][2]), 44]]
    with pytest.raises(CaphyError, match=r"more than two faces.*mesh editor"):
        clean_mesh(read_mesh(write_obj(tmp_path / "fin.obj", vertices, fin)))
    turned = faces.copy()
    turned[20] = turned[20][::-1]
    raw = read_mesh(write_obj(tmp_path / "turned.obj", vertices, turned))
    with pytest.raises(CaphyError, match=r"opposite senses.*pass --rewind"):
        clean_mesh(raw)
    np.testing.assert_array_equal(clean_mesh(raw, rewind=True).faces, faces)


def test_panels_in_metres_are_the_rest_metric_even_if_mirrored(strip, tmp_path, marks):
    vertices, faces = strip
    uv = vertices[:, :2] * [-1.05, 1.0]  # 5 % wider than the 3-D mesh, and drawn mirrored
    mesh = clean_mesh(read_mesh(write_obj(tmp_path / "p.obj", vertices, faces, uv)))
    material, metric = rest_metric(mesh, marks)
    assert metric == "panel coordinates"
    assert np.all(panels.signed_areas(material) > 0)
    np.testing.assert_allclose(panels.signed_areas(material).sum(), 0.4 * 0.8 * 1.05)


@pytest.mark.parametrize("factor", [0.05, 3.0])
def test_texture_coordinates_are_reported_and_not_used(strip, tmp_path, marks, factor):
    vertices, faces = strip
    mesh = clean_mesh(read_mesh(write_obj(tmp_path / "t.obj", vertices, faces, vertices[:, :2] * factor)))
    material, metric = rest_metric(mesh, marks)
    assert "texture coordinates" in metric and f"--panel-scale {1 / factor:.3g}" in metric
    assert f"--panel-scale {1 / factor:.3g}" in rest_metric(mesh, marks, panel_scale=7.0)[1]  # whatever was tried
    solid = panels.edge_lengths(mesh.vertices[mesh.faces])
    np.testing.assert_allclose(panels.edge_lengths(material), solid, atol=1e-12)
    assert rest_metric(mesh, marks, panel_scale=1 / factor)[1] == "panel coordinates"


def test_berkeley_tshirt(shared_data, marks, tmp_path):
    path = shared_data / "garments" / "berkeley_tshirt" / "tshirt.obj"
    with pytest.raises(CaphyError, match="pass --up z"):
        clean_mesh(read_mesh(path))
    options = ["--up", "z", "--offset", "0", "0.15", "0", "-o", str(tmp_path / "b.npz")]
    command.main(["from-mesh", str(path), *options])
    garment = Garment.load(tmp_path / "b.npz")
    assert garment.provenance["metric"] == "panel coordinates" and len(garment.vertices) == 330
    # the panels' area, read from the file by other means
    rows = [line.split() for line in path.read_text().splitlines()]
    uv = np.array([r[1:3] for r in rows if r and r[0] == "vt"], float)
    corner = np.array([[int(c.split("/")[1]) - 1 for c in r[1:]] for r in rows if r and r[0] == "f"])
    solid = np.concatenate([uv[corner], np.zeros((len(corner), 3, 1))], axis=2)
    assert garment.rest_areas.sum() == pytest.approx(trimesh.triangles.area(solid).sum(), rel=1e-6)


def test_makehuman_outfit_leads_the_user_step_by_step(shared_data, marks):
    raw = read_mesh(shared_data / "garments" / "makehuman_clothes" / "male_casualsuit04.obj")
    steps = [
        ({}, "--triangulate"),
        ({"triangulate": True}, "--component upper"),
        ({"triangulate": True, "component": "upper"}, r"--scale 0\.1 \(decimetres\)"),
    ]
    for options, hint in steps:
        with pytest.raises(CaphyError, match=hint):
            clean_mesh(raw, **options)
    upper = clean_mesh(raw, triangulate=True, component="upper", scale=0.1)
    lower = clean_mesh(raw, triangulate=True, component="lower", scale=0.1)
    assert upper.vertices[:, 1].mean() > lower.vertices[:, 1].mean()
    garment = garment_from_mesh(lower, "trousers", marks, waistband=True)
    assert "texture coordinates" in garment.provenance["metric"] and (garment.attached == 1).sum() > 10


def test_a_garment_far_from_the_body_is_refused(strip, tmp_path, marks):
    vertices, faces = strip
    mesh = clean_mesh(read_mesh(write_obj(tmp_path / "far.obj", vertices + np.array([0, 3, 0]), faces)))
    with pytest.raises(CaphyError, match="pass --offset"):
        garment_from_mesh(mesh, "far", marks)


@pytest.mark.parametrize("kind", ["tshirt", "trousers"])
def test_a_garment_made_with_feet_on_the_ground_is_told_how_far_to_move(marks, kind):
    """Nearest points alone would hang trousers on the arms."""
    made = make(FAMILIES[kind](edge_length=0.04), marks.body)
    stand = -marks.vertices[:, 1].min()
    here = UserMesh(made.vertices, made.faces, None)
    assert garment_from_mesh(here, "mine", marks).vertices.shape == made.vertices.shape
    for wrong in (0.0, 0.1):  # another body's height
        raised = replace(here, vertices=made.vertices + np.array([0.0, stand + wrong, 0.0]))
        with pytest.raises(CaphyError, match=rf"feet at y = 0; pass --offset 0 {-stand:.3f} 0"):
            garment_from_mesh(raised, "mine", marks)


def test_one_piece_has_no_upper_part(strip, tmp_path):
    raw = read_mesh(write_obj(tmp_path / "one.obj", *strip))
    with pytest.raises(CaphyError, match="one connected piece, so that none is upper"):
        clean_mesh(raw, component="upper")
    with pytest.raises(CaphyError, match="component must be upper, lower or 0 to 0"):
        clean_mesh(raw, component="²")


@pytest.mark.parametrize("scale", ["0", "nan", "-0.1", "inf"])
def test_a_scale_that_is_none_is_told_as_that(strip, tmp_path, capsys, scale):
    path = write_obj(tmp_path / "one.obj", *strip)
    assert main(["garment", "check", str(path), "--scale", scale]) == 2
    assert "--scale must be positive" in capsys.readouterr().err
