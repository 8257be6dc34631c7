"""4D-DRESS's layout: pickles of arrays become a scan set; anything else in them is refused."""

from __future__ import annotations

import pickle
import weakref

import numpy as np
import pytest
import trimesh

from caphy.cli import main
from caphy.errors import CaphyError
from caphy.scan import dress4d
from caphy.scan.dress4d import convert_take
from caphy.scan.scan import BODY, LOWER, UPPER
from caphy.scan.scan_set import ScanSet

BOX = trimesh.creation.box((0.4, 1.7, 0.3)).subdivide()


def _dump(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content))


def _take(folder, frames=("00011", "00012")):
    """A take as published: meshes with uvs, textures, labels, SMPL-X."""
    random = np.random.default_rng(0)
    count = len(BOX.vertices)
    texture = np.zeros((8, 8, 3), np.uint8)
    texture[:, :4], texture[:4, 4:], texture[4:, 4:] = (10, 20, 30), (40, 50, 60), (70, 80, 90)
    uvs = np.tile([[0.1, 0.5], [0.9, 0.9], [0.9, 0.1]], (count, 1))[:count]
    for frame in frames:
        mesh = {"vertices": np.array(BOX.vertices), "faces": np.array(BOX.faces), "uvs": uvs}
        _dump(folder / "Meshes_pkl" / f"mesh-f{frame}.pkl", mesh | {"normals": np.array(BOX.vertex_normals)})
        _dump(folder / "Meshes_pkl" / f"atlas-f{frame}.pkl", texture)
        _dump(folder / "Semantic" / "labels" / f"label-f{frame}.pkl", {"scan_labels": np.arange(count) % 6})
        body = {"global_orient": random.normal(size=3), "body_pose": random.normal(size=63), "transl": np.ones(3)}
        body |= {"betas": np.zeros(10), "jaw_pose": np.zeros(3), "left_hand_pose": np.zeros(12)}
        _dump(folder / "SMPLX" / f"mesh-f{frame}_smplx.pkl", body)
    return folder


def test_a_take_becomes_a_scan_set(tmp_path):
    take = _take(tmp_path / "Take1")
    scans = convert_take(take, tmp_path / "set")
    assert scans.names == ("f00011", "f00012")
    scan = ScanSet.read(tmp_path / "set")[1]
    assert scan.vertices == pytest.approx(np.array(BOX.vertices), abs=1e-6)
    assert np.array_equal(
        scan.labels, np.array([BODY, BODY, BODY, UPPER, LOWER, UPPER])[np.arange(len(scan.labels)) % 6]
    )
    assert [list(c) for c in scan.colours[:3]] == [[10, 20, 30], [40, 50, 60], [70, 80, 90]]  # v is up in a texture
    given = pickle.loads((take / "SMPLX" / "mesh-f00012_smplx.pkl").read_bytes())
    assert scan.pose[0] == pytest.approx(given["global_orient"])
    assert scan.pose[1:22].ravel() == pytest.approx(given["body_pose"])
    assert scan.transl == pytest.approx(1)


def test_scans_are_read_one_at_a_time_and_bad_ones_keep_no_pose(tmp_path, monkeypatch):
    """A take of 80,000 vertices a frame may not fit into memory."""
    take = _take(tmp_path / "Take1", ("00001", "00002", "00003"))
    (take / "SMPLX" / "mesh-f00002_smplx.pkl").write_bytes(b"broken")
    alive, most = [], []

    def noted(scan_of):
        def scan(take, path):
            made = scan_of(take, path)
            alive.append(weakref.ref(made))
            most.append(sum(each() is not None for each in alive))
            return made

        return scan

    monkeypatch.setattr(dress4d, "_scan", noted(dress4d._scan))
    said = []
    scans = convert_take(take, tmp_path / "set", say=said.append)
    assert scans.names == ("f00001", "f00003") and len(said) == 1 and "f00002" in said[0]
    assert max(most) == 2  # the one being read, and the one before it
    given = pickle.loads((take / "SMPLX" / "mesh-f00003_smplx.pkl").read_bytes())
    assert scans[1].pose[0] == pytest.approx(given["global_orient"])


def test_a_frame_whose_motion_is_no_number_is_left_out(tmp_path):
    """It ended the conversion, and left a set that looked whole and had no poses."""
    take = _take(tmp_path / "Take1", ("00001", "00002"))
    path = take / "SMPLX" / "mesh-f00002_smplx.pkl"
    path.write_bytes(pickle.dumps(pickle.loads(path.read_bytes()) | {"transl": np.full(3, np.nan)}))
    said = []
    scans = convert_take(take, tmp_path / "set", say=said.append)
    assert scans.names == ("f00001",) and scans.poses is not None and len(said) == 1 and "f00002" in said[0]


def test_a_frame_without_a_motion_is_said_to_cost_all_poses(tmp_path, capsys):
    take = _take(tmp_path / "Take1", ("00001", "00002", "00003"))
    (take / "SMPLX" / "mesh-f00002_smplx.pkl").unlink()
    assert main(["scans", "from-4d-dress", str(take), "--output", str(tmp_path / "set")]) == 0
    said = capsys.readouterr().out
    assert "no initial poses are written" in said and "of frame f00002\n" in said
    assert len(ScanSet.read(tmp_path / "set")) == 3
    for path in (take / "SMPLX").iterdir():
        path.unlink()
    said = []
    assert convert_take(take, tmp_path / "other", say=said.append).poses is None and not said  # none were given


def test_every_other_frame(tmp_path):
    take = _take(tmp_path / "Take1", ("00001", "00002", "00003"))
    assert convert_take(take, tmp_path / "set", every=2).names == ("f00001", "f00003")


def test_frames_of_another_choice_are_not_mixed_in(tmp_path):
    take = _take(tmp_path / "𠮷", ("00001", "00002", "00003"))
    assert convert_take(take, tmp_path / "set", every=2).name == "𠮷"
    with pytest.raises(CaphyError, match=r"holds other scans \(f00003\); give an empty folder"):
        convert_take(take, tmp_path / "set", every=3)
    assert len(convert_take(take, tmp_path / "set", every=2)) == 2


class _Evil:
    def __reduce__(self):
        return print, ("run",)


def test_a_pickle_that_asks_for_code_is_left_out_and_never_run(tmp_path, capsys):
    take = _take(tmp_path / "Take1")
    _dump(take / "Meshes_pkl" / "mesh-f00011.pkl", _Evil())
    told = []
    assert convert_take(take, tmp_path / "set", say=told.append).names == ("f00012",)
    assert "not on the list of harmless names" in told[0]
    assert capsys.readouterr().out == ""


def test_labels_of_another_mesh_are_left_out(tmp_path):
    take = _take(tmp_path / "Take1")
    _dump(take / "Semantic" / "labels" / "label-f00012.pkl", {"scan_labels": np.zeros(3, int)})
    told = []
    assert convert_take(take, tmp_path / "set", say=told.append).names == ("f00011",)
    assert "labels must have shape" in told[0]


def test_what_is_no_take(tmp_path):
    with pytest.raises(CaphyError, match="holds no Meshes_pkl"):
        convert_take(tmp_path, tmp_path / "set")


@pytest.mark.parametrize(
    ("folder", "changes", "says"),
    [
        ("SMPLX/mesh-f00002_smplx.pkl", {"transl": np.ones(2)}, "transl must be three numbers"),
        ("SMPLX/mesh-f00002_smplx.pkl", {"betas": np.zeros(5)}, ""),
        ("Meshes_pkl/mesh-f00002.pkl", {"uvs": np.full((len(BOX.vertices), 2), np.nan)}, "uvs must be finite"),
        ("Semantic/labels/label-f00002.pkl", {"scan_labels": np.arange(len(BOX.vertices)) % 6 + 0.5}, "whole numbers"),
    ],
)
def test_a_strange_frame_is_named_and_the_others_are_converted(tmp_path, folder, changes, says):
    take = _take(tmp_path / "Take1", ("00001", "00002", "00003"))
    path = take / folder
    path.write_bytes(pickle.dumps(pickle.loads(path.read_bytes()) | changes))
    said = []
    scans = convert_take(take, tmp_path / "set", say=said.append)
    assert len(said) == bool(says) and says in "".join(said)
    assert scans.names == (("f00001", "f00003") if says else ("f00001", "f00002", "f00003"))
    assert scans.poses is not None


def test_colours_that_are_no_table_are_told(tmp_path):
    take = _take(tmp_path / "Take1", ("00001", "00002"))
    (take / "Meshes_pkl" / "atlas-f00002.pkl").unlink()
    path = take / "Meshes_pkl" / "mesh-f00002.pkl"
    path.write_bytes(pickle.dumps(pickle.loads(path.read_bytes()) | {"colors": np.ones(len(BOX.vertices))}))
    said = []
    assert convert_take(take, tmp_path / "set", say=said.append).names == ("f00001",)
    assert "colors must be finite, of shape" in said[0]
