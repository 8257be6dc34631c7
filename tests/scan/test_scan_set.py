"""Sets of scans: every kind of file, units, axes, labels, poses; and what is said of bad ones."""

from __future__ import annotations

import errno
import shutil

import cv2
import numpy as np
import pytest
import trimesh

from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence
from caphy.io.poses.canonical import write_poses
from caphy.scan.scan import UNKNOWN, Scan
from caphy.scan.scan_set import ScanSet, write_labels, write_scan_set

BOX = trimesh.creation.box((0.4, 1.7, 0.3)).subdivide()


def _describe(folder, text='unit = "m"\nup_axis = "y"\n'):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scans.toml").write_text(text)


def _coloured(count):
    return np.random.default_rng(0).integers(0, 255, (count, 3)).astype(np.uint8)


def test_ply_with_colours_and_labels(tmp_path):
    _describe(tmp_path)
    mesh = BOX.copy()
    colours = _coloured(len(mesh.vertices))
    labels = (np.arange(len(mesh.vertices)) % 3).astype(np.uint8)
    mesh.visual.vertex_colors = colours
    mesh.vertex_attributes["label"] = labels
    mesh.export(tmp_path / "one.ply")
    (scan,) = ScanSet.read(tmp_path)
    assert scan.name == "one"
    assert scan.vertices == pytest.approx(mesh.vertices, abs=1e-6)
    assert np.array_equal(scan.faces, mesh.faces)
    assert np.array_equal(scan.colours, colours)
    assert np.array_equal(scan.labels, labels)
    assert (np.einsum("vc,vc->v", scan.normals, scan.vertices) > 0).all()


def test_obj_with_a_texture_keeps_the_order_of_its_vertices(tmp_path):
    """A quad in two triangles whose texture has a seam: four positions, six texture coordinates."""
    _describe(tmp_path)
    image = np.zeros((10, 10, 3), np.uint8)
    image[:, :5], image[:, 5:] = (0, 0, 255), (255, 0, 0)  # blue-green-red: left half red, right half blue
    cv2.imwrite(str(tmp_path / "skin.png"), image)
    (tmp_path / "quad.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    (tmp_path / "quad.obj").write_text(
        "mtllib quad.mtl\nusemtl skin\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
        "vt 0.1 0.1\nvt 0.2 0.1\nvt 0.2 0.3\nvt 0.9 0.1\nvt 0.8 0.3\nvt 0.9 0.9\nf 1/1 2/2 3/3\nf 1/4 3/5 4/6\n"
    )
    (scan,) = ScanSet.read(tmp_path)
    assert scan.vertices == pytest.approx(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), abs=1e-9)
    assert len(scan.faces) == 2
    assert scan.faces.max() == 3
    assert list(scan.colours[1]) == [255, 0, 0]
    assert list(scan.colours[3]) == [0, 0, 255]
    text = (tmp_path / "quad.obj").read_text()
    for name in ("our quad.mtl", "quad.mtl"):
        shutil.move(next(tmp_path.glob("*.mtl")), tmp_path / name)
        (tmp_path / "quad.obj").write_text(text.replace("mtllib quad.mtl", f"mtllib {name}"))
        (scan,) = ScanSet.read(tmp_path)
        assert list(scan.colours[1]) == [255, 0, 0]
    (tmp_path / "quad.mtl").unlink()  # readers make a grey of their own then
    (scan,) = ScanSet.read(tmp_path)
    assert scan.colours is None and len(scan.vertices) == 4


def test_a_damaged_texture_costs_only_its_own_scan(tmp_path):
    _describe(tmp_path)
    cv2.imwrite(str(tmp_path / "skin.png"), np.random.default_rng(0).integers(0, 255, (20, 20, 3), np.uint8))
    picture = (tmp_path / "skin.png").read_bytes()
    (tmp_path / "quad.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    (tmp_path / "quad.obj").write_text(
        "mtllib quad.mtl\nusemtl skin\nv 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0.1 0.1\nvt 0.2 0.1\nvt 0.2 0.3\nf 1/1 2/2 3/3\n"
    )
    scans = ScanSet.read(tmp_path)
    assert scans[0].colours is not None
    (tmp_path / "skin.png").write_bytes(picture[: len(picture) // 2])
    with pytest.raises(CaphyError, match=r"quad\.obj: its texture cannot be read .*; copy the picture again"):
        scans[0]


def test_labels_that_a_full_disk_cuts_short_are_not_there(tmp_path, monkeypatch):
    def full(*places):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(CaphyError, match=r"one\.npy: cannot be written \(No space left on device\); free space"):
        write_labels(tmp_path / "one.npy", np.zeros(3, np.uint8))
    assert not list(tmp_path.iterdir())


def test_glb_whose_triangles_share_no_vertices_is_joined(tmp_path):
    _describe(tmp_path)
    mesh = BOX.copy()
    mesh.visual.vertex_colors = _coloured(len(mesh.vertices))
    mesh.unmerge_vertices()
    mesh.export(tmp_path / "one.glb")
    (scan,) = ScanSet.read(tmp_path)
    assert len(scan.vertices) == len(BOX.vertices) < len(mesh.vertices)
    assert trimesh.Trimesh(scan.vertices, scan.faces, process=False).is_watertight
    assert np.ptp(scan.vertices, axis=0) == pytest.approx([0.4, 1.7, 0.3], abs=1e-6)
    key = {tuple(np.round(v, 5)): c for v, c in zip(mesh.vertices, mesh.visual.vertex_colors[:, :3], strict=True)}
    assert all(np.array_equal(key[tuple(np.round(v, 5))], c) for v, c in zip(scan.vertices, scan.colours, strict=True))


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_units_and_axes(tmp_path, up):
    """A mast in millimetres along the up axis, marked at its top, is upright in metres and not mirrored."""
    _describe(tmp_path, f'unit = "mm"\nup_axis = "{up}"\n')
    sign, axis = (-1 if up[0] == "-" else 1), "xyz".index(up[-1])
    mesh = BOX.copy()
    vertices = np.zeros_like(mesh.vertices)
    vertices[:, axis] = sign * mesh.vertices[:, 1] * 1000
    vertices[:, (axis + 1) % 3] = mesh.vertices[:, 0] * 1000
    vertices[:, (axis + 2) % 3] = mesh.vertices[:, 2] * 1000
    trimesh.Trimesh(vertices, mesh.faces, process=False).export(tmp_path / "one.ply")
    scans = ScanSet.read(tmp_path)
    (scan,) = scans
    assert scan.vertices[:, 1] == pytest.approx(mesh.vertices[:, 1], abs=1e-5)
    assert np.ptp(scan.vertices, axis=0).max() == pytest.approx(1.7, abs=1e-5)
    assert np.linalg.det(scans.rotation) == pytest.approx(1)


def test_what_is_written_is_read(tmp_path):
    poses = PoseSequence(np.random.default_rng(1).normal(0, 0.1, (2, 55, 3)), np.ones((2, 3)), fps=1.0)
    labels = np.arange(len(BOX.vertices)) % 3
    made = [
        Scan(name, np.array(BOX.vertices), np.array(BOX.faces), _coloured(len(BOX.vertices)), labels.astype(np.uint8))
        for name in ("a", "b")
    ]
    write_scan_set(tmp_path / "set", made, "somebody", poses)
    scans = ScanSet.read(tmp_path / "set")
    assert scans.name == "somebody"
    assert scans.names == ("a", "b")
    assert scans[1].vertices == pytest.approx(made[1].vertices, abs=1e-6)
    assert np.array_equal(scans[1].labels, labels)
    assert scans[1].pose == pytest.approx(poses.poses[1])
    assert scans[1].pelvis == pytest.approx(poses.transl[1] + poses.pelvis)


def test_labels_beside_the_scans_and_elsewhere(tmp_path):
    _describe(tmp_path, 'unit = "m"\nup_axis = "y"\nlabel_numbers = {body = [0, 1, 2], upper = [3, 5], lower = [4]}\n')
    BOX.export(tmp_path / "one.ply")
    numbers = np.arange(len(BOX.vertices)) % 6
    (tmp_path / "labels").mkdir()
    np.save(tmp_path / "labels" / "one.npy", numbers)
    assert np.array_equal(ScanSet.read(tmp_path)[0].labels, np.array([0, 0, 0, 1, 2, 1])[numbers])
    write_labels(tmp_path / "other" / "one.npy", np.full(len(numbers), UNKNOWN))
    assert (ScanSet.read(tmp_path, tmp_path / "other")[0].labels == UNKNOWN).all()
    np.save(tmp_path / "other" / "one.npy", numbers)
    with pytest.raises(CaphyError, match=r"got 3; what scans\.toml says of numbers goes for the set's own labels"):
        ScanSet.read(tmp_path, tmp_path / "other")[0]


def _bad_nan(folder):
    mesh = BOX.copy()
    vertices = np.array(mesh.vertices)
    vertices[3, 1] = np.nan
    trimesh.Trimesh(vertices, mesh.faces, process=False).export(folder / "two.ply")


def test_labels_in_another_folder_are_instead_of_those_in_the_scans(tmp_path):
    """A scan that has none there was left out when they were made."""
    _describe(tmp_path)
    labels = (np.arange(len(BOX.vertices)) % 3).astype(np.uint8)
    write_scan_set(
        tmp_path, [Scan(name, np.array(BOX.vertices), np.array(BOX.faces), None, labels) for name in "ab"], "s"
    )
    write_labels(tmp_path / "other" / "a.npy", labels[::-1])
    first, second = ScanSet.read(tmp_path, tmp_path / "other")
    assert np.array_equal(first.labels, labels[::-1]) and second.labels is None
    (tmp_path / "other").rename(tmp_path / "labels")
    first, second = ScanSet.read(tmp_path)
    assert np.array_equal(first.labels, labels[::-1]) and np.array_equal(second.labels, labels)


def test_what_lies_beyond_a_set_s_folder_is_known(tmp_path):
    folder = tmp_path / "set"
    _describe(folder, 'unit = "m"\nup_axis = "y"\nlabels = "../labels"\nposes = "../poses.npz"\n')
    (tmp_path / "labels").mkdir()
    write_poses(PoseSequence(np.zeros((2, 55, 3)), np.zeros((2, 3)), 1.0), tmp_path / "poses.npz")
    BOX.export(folder / "one.ply")
    BOX.export(tmp_path / "other.ply")
    (folder / "two.ply").symlink_to(tmp_path / "other.ply")
    beyond = {path.resolve() for path in ScanSet.read(folder).beyond}
    assert beyond == {tmp_path / "labels", tmp_path / "poses.npz", tmp_path / "other.ply"}
    write_poses(PoseSequence(np.zeros((2, 55, 3)), np.zeros((2, 3)), 1.0), folder / "poses.npz")
    (folder / "two.ply").unlink()
    BOX.export(folder / "two.ply")
    _describe(folder, 'unit = "m"\nup_axis = "y"\nposes = "poses.npz"\n')
    assert ScanSet.read(folder).beyond == ()


def _bad_labels(folder):
    np.save(folder / "labels" / "two.npy", np.zeros(3, np.uint8))


def _strange_label(folder):
    np.save(folder / "labels" / "two.npy", np.full(len(BOX.vertices), 7))


def _cloud(folder):
    trimesh.PointCloud(BOX.vertices).export(folder / "two.ply")


def _cut_short(folder):
    path = folder / "two.ply"
    path.write_bytes(path.read_bytes()[:300])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_bad_nan, "vertices must be finite"),
        (_bad_labels, "has 3 labels for the"),
        (_strange_label, "got 7; say in scans.toml what your numbers mean"),
        (_cloud, "must be a triangle mesh"),
        (_cut_short, "cannot be read as a mesh"),
    ],
)
def test_a_bad_scan_is_named_and_the_others_are_read(tmp_path, damage, message):
    _describe(tmp_path)
    (tmp_path / "labels").mkdir()
    for name in ("one", "two", "three"):
        BOX.export(tmp_path / f"{name}.ply")
    damage(tmp_path)
    scans = ScanSet.read(tmp_path)
    with pytest.raises(CaphyError, match=message) as caught:
        scans[scans.names.index("two")]
    assert "two" in str(caught.value)
    assert all(len(scans[scans.names.index(name)].vertices) for name in ("one", "three"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('unit = "m"\n', "up_axis must be one of"),
        ('unit = "yard"\nup_axis = "y"\n', "unit must be one of m, dm, cm, mm, inch"),
        ('unit = "m"\nup_axis = "y"\nfps = 30\n', "keys nobody reads: fps"),
        ("unit = ", "cannot be read"),
        ('unit = "m"\nup_axis = "y"\nscans = "*.stl"\n', "holds no scans"),
        ('unit = "m"\nup_axis = "y"\nlabel_numbers = {hat = [1]}\n', "label_numbers must name body, upper, lower"),
    ],
)
def test_bad_descriptions(tmp_path, text, message):
    _describe(tmp_path, text)
    BOX.export(tmp_path / "one.ply")
    with pytest.raises(CaphyError, match=message):
        ScanSet.read(tmp_path)


def test_poses_must_be_as_many_as_scans(tmp_path):
    _describe(tmp_path, 'unit = "m"\nup_axis = "y"\nposes = "poses.npz"\n')
    BOX.export(tmp_path / "one.ply")
    write_poses(PoseSequence(np.zeros((3, 55, 3)), np.zeros((3, 3)), fps=1.0), tmp_path / "poses.npz")
    with pytest.raises(CaphyError, match="holds 3 poses for 1 scans"):
        ScanSet.read(tmp_path)


def test_the_order_of_scans_is_the_same_whatever_kind_of_file_they_are(tmp_path):
    """'s.obj' comes before 's.p.obj', but 's.p.ply' before 's.ply': written again they would exchange their poses."""
    _describe(tmp_path / "given")
    for name in ("s", "s.p"):
        BOX.export(tmp_path / "given" / f"{name}.obj")
    given = ScanSet.read(tmp_path / "given")
    again = write_scan_set(tmp_path / "again", list(given), "somebody")
    assert given.names == again.names == ("s", "s.p")


def test_what_a_mac_leaves_beside_each_file_is_no_scan(tmp_path):
    _describe(tmp_path)
    BOX.export(tmp_path / "one.ply")
    (tmp_path / "._one.ply").write_bytes(b"\0\5\x16\7")
    assert ScanSet.read(tmp_path).names == ("one",)
    _describe(tmp_path, 'unit = "m"\nup_axis = "y"\nscans = "*.ply"\n')
    assert ScanSet.read(tmp_path).names == ("one",)


def test_poses_go_by_the_scans_names_whatever_folders_they_lie_in(tmp_path):
    _describe(tmp_path, 'unit = "m"\nup_axis = "y"\nscans = "*/*.ply"\nposes = "poses.npz"\n')
    for place in ("day1/z", "day2/a"):
        (tmp_path / place).parent.mkdir()
        BOX.export(tmp_path / f"{place}.ply")
    write_poses(
        PoseSequence(np.zeros((2, 55, 3)), np.array([[1.0, 0, 0], [2.0, 0, 0]]), fps=1.0), tmp_path / "poses.npz"
    )
    scans = ScanSet.read(tmp_path)
    assert scans.names == ("a", "z") and [scan.transl[0] for scan in scans] == [1.0, 2.0]


def test_a_folder_without_description(tmp_path):
    BOX.export(tmp_path / "one.ply")
    with pytest.raises(CaphyError, match="a folder of scans needs a"):
        ScanSet.read(tmp_path)


def test_two_files_of_one_name(tmp_path):
    _describe(tmp_path)
    BOX.export(tmp_path / "one.ply")
    shutil.copy(tmp_path / "one.ply", tmp_path / "one.obj")
    with pytest.raises(CaphyError, match="several scans are named one"):
        ScanSet.read(tmp_path)


def test_an_ascii_ply_is_read_like_a_binary_one(tmp_path):
    _describe(tmp_path)
    mesh = BOX.copy()
    mesh.visual.vertex_colors = _coloured(len(mesh.vertices))
    mesh.vertex_attributes["label"] = (np.arange(len(mesh.vertices)) % 3).astype(np.uint8)
    (tmp_path / "one.ply").write_bytes(mesh.export(file_type="ply", encoding="ascii"))
    (scan,) = ScanSet.read(tmp_path)
    assert scan.vertices == pytest.approx(mesh.vertices, abs=1e-6)
    assert np.array_equal(scan.colours, mesh.visual.vertex_colors[:, :3])
    assert np.array_equal(scan.labels, mesh.vertex_attributes["label"])


def test_labels_of_a_glb_are_in_the_order_of_its_vertices(tmp_path):
    _describe(tmp_path)
    mesh = BOX.copy()
    order = np.random.default_rng(3).permutation(len(mesh.vertices))
    mesh = trimesh.Trimesh(mesh.vertices[order], np.argsort(order)[mesh.faces], process=False)
    labels = (mesh.vertices[:, 1] > 0.5).astype(np.uint8)
    mesh.export(tmp_path / "one.glb")
    (tmp_path / "labels").mkdir()
    np.save(tmp_path / "labels" / "one.npy", labels)
    (scan,) = ScanSet.read(tmp_path)
    assert np.array_equal(scan.labels, scan.vertices[:, 1] > 0.5)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('labels = "lables"', "lables: there is no such folder of labels"),
        ("label_numbers = {body = [-1], upper = [3]}", "from 0 to 65535"),
        ("label_numbers = {body = [99999999999]}", "from 0 to 65535"),
    ],
)
def test_descriptions_that_cannot_be_followed(lines, words, tmp_path):
    _describe(tmp_path, f'unit = "m"\nup_axis = "y"\n{lines}\n')
    BOX.export(tmp_path / "one.ply")
    with pytest.raises(CaphyError, match=words):
        ScanSet.read(tmp_path)


def test_a_description_with_a_byte_order_mark(tmp_path):
    BOX.export(tmp_path / "one.ply")
    (tmp_path / "scans.toml").write_text('unit = "m"\nup_axis = "y"\n', encoding="utf-8-sig")
    assert len(ScanSet.read(tmp_path)) == 1
    (tmp_path / "scans.toml").write_text('unit = ["m"]\nup_axis = "y"\n')
    with pytest.raises(CaphyError, match="unit must be one of"):
        ScanSet.read(tmp_path)
