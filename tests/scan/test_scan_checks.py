"""Checks of scans: each fault is found, named and comes with a remedy; sound scans pass."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh

from caphy.body.bundled import default_body
from caphy.capture.poses import a_pose
from caphy.cli import main
from caphy.commands.fit_scans import check_scans
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence
from caphy.scan.checks import check_scan, check_set, usable
from caphy.scan.mesh_files import MeshFile, read_mesh_file, write_ply
from caphy.scan.scan import LOWER, UNKNOWN, UPPER, Scan
from caphy.scan.scan_set import ScanSet, write_scan_set


@cache
def _person():
    """A person in A-pose, painted and labelled by height: vertices, faces, colours, labels."""
    body = default_body("medium")
    vertices = body.pose(a_pose()[None])[0]
    height = vertices[:, 1]
    labels = np.where(height > 0.4, 0, np.where(height > -0.05, UPPER, LOWER)).astype(np.uint8)
    labels[height < -0.7] = 0
    colours = np.array([(200, 160, 140), (40, 60, 130), (90, 30, 30)], np.uint8)[labels]
    return vertices, body.faces, colours, labels


def _scan(**changed):
    vertices, faces, colours, labels = _person()
    return Scan(**({"name": "p", "vertices": vertices, "faces": faces, "colours": colours, "labels": labels} | changed))


def _beside(mesh: trimesh.Trimesh):
    """The person and another mesh in one scan."""
    vertices, faces, _, _ = _person()
    both = trimesh.util.concatenate([trimesh.Trimesh(vertices, faces, process=False), mesh])
    return _scan(vertices=np.array(both.vertices), faces=np.array(both.faces), colours=None, labels=None)


def _floor():
    vertices = _person()[0]
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 11), np.linspace(-0.5, 0.5, 11))
    points = np.stack([x.ravel(), np.full(x.size, vertices[:, 1].min()), z.ravel()], axis=1)
    a = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    tiles = np.concatenate([np.stack([a, a + 11, a + 1], 1), np.stack([a + 1, a + 11, a + 12], 1)])
    return _beside(trimesh.Trimesh(points, tiles, process=False))


def _twin():
    vertices, faces, _, _ = _person()
    return _beside(trimesh.Trimesh(vertices + np.array([0.9, 0, 0]), faces, process=False))


def _soup():
    vertices, faces, _, _ = _person()
    return _scan(
        vertices=vertices[faces.ravel()], faces=np.arange(3 * len(faces)).reshape(-1, 3), colours=None, labels=None
    )


def _holed():
    _, faces, _, _ = _person()
    return _scan(faces=faces[np.random.default_rng(0).random(len(faces)) > 0.05])


def _cut(share):
    _, faces, _, _ = _person()
    return _scan(faces=faces[: int(share * len(faces))])


FAULTS = {
    "cut short": (lambda: _cut(0.7), True, "of its vertices belong to no triangle; was the file cut short?"),
    "cut a little short": (lambda: _cut(0.8), False, "was the file cut short?"),
    "millimetres": (lambda: _scan(vertices=1000 * _person()[0]), True, 'try unit = "mm"'),
    "flipped": (lambda: _scan(faces=_person()[1][:, ::-1]), True, "triangles face inward"),
    "floor": (_floor, True, "m2 of floor; cut away"),
    "two people": (_twin, True, "two large pieces"),
    "soup": (_soup, True, "merge vertices"),
    "holes": (_holed, False, "has many holes"),
    "empty labels": (lambda: _scan(labels=np.full(len(_person()[0]), UNKNOWN, np.uint8)), True, "labels are empty"),
    "no clothes": (lambda: _scan(labels=np.zeros(len(_person()[0]), np.uint8)), True, "shows no clothes"),
    "no trousers": (lambda: _scan(labels=np.where(_person()[3] == LOWER, 0, _person()[3])), False, "shows no lower"),
    "no colours": (lambda: _scan(colours=None), False, "has no colours"),
    "one colour": (lambda: _scan(colours=np.full_like(_person()[2], 100)), False, "has one colour all"),
}


def test_a_sound_scan_passes():
    assert check_scan(_scan()) == []


def test_places_that_a_texture_s_seams_list_twice_are_not_missing_triangles():
    """As an OBJ's repeated lines are read: the first of each bears the triangles."""
    vertices, faces, colours, labels = _person()
    twice = np.arange(0, len(vertices), 3)
    again = [np.concatenate([given, given[twice]]) for given in (vertices, colours, labels)]
    assert check_scan(_scan(vertices=again[0], faces=faces, colours=again[1], labels=again[2])) == []


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_named(fault):
    make, severe, words = FAULTS[fault]
    found = check_scan(make())
    assert any(words in finding.message and finding.severe == severe for finding in found), found
    assert all(finding.severe == severe for finding in found if words in finding.message)


def _set(folder, scans):
    return write_scan_set(folder, scans, "somebody")


def test_a_stranger_among_the_scans_is_refused_and_the_others_stay(tmp_path):
    other = 255 - _person()[2]
    scans = [_scan(name=f"s{i}") for i in range(5)] + [_scan(name="stranger", colours=other)]
    scans = _set(tmp_path / "set", scans)
    findings = check_set(scans)
    assert [(f.scan, f.severe) for f in findings] == [("stranger", True)]
    assert "is it another person" in findings[0].message
    assert [scans.names[i] for i in usable(scans, findings)] == [f"s{i}" for i in range(5)]


@pytest.mark.parametrize("bare", [(), ("s2",)])
def test_the_check_of_a_fit_reads_each_scan_twice(bare, tmp_path, monkeypatch):
    """Once to judge it, once to write it: reading takes most of the stage."""
    scans = [_scan(name=f"s{i}") for i in range(3)]
    scans = [replace(scan, labels=None) if scan.name in bare else scan for scan in scans]
    folder, read = _set(tmp_path / "set", scans).folder, Counter()

    def counted(path):
        read[path.parent.name, path.stem] += 1
        return read_mesh_file(path)

    monkeypatch.setattr("caphy.scan.scan_set.read_mesh_file", counted)
    check_scans(folder, tmp_path / "run", None)
    assert read == {("set", f"s{i}"): 2 for i in range(3)}
    assert json.loads((tmp_path / "run" / "check.json").read_text())["parser"] == ("colour" if bare else "labels")
    for scan, written in zip(scans, ScanSet.read(tmp_path / "run" / "scans"), strict=True):
        assert written.labels is None if bare else (written.labels == scan.labels).all()


def test_a_scan_without_labels_among_others_that_have_them_is_told(tmp_path, capsys):
    """Labels by hand would not be used, and nobody knew."""
    scans = [_scan(name=f"s{i}", labels=None if i == 1 else _scan().labels) for i in range(3)]
    check_scans(_set(tmp_path / "set", scans).folder, tmp_path / "run", None)
    assert "note: s1: has no labels, so those of the 2 others are not used" in capsys.readouterr().out
    assert "--parser labels" in json.loads((tmp_path / "run" / "check.json").read_text())["notes"]["s1"]
    check_scans(tmp_path / "set", tmp_path / "other", "colour")
    assert "note" not in capsys.readouterr().out


def test_poses_for_scans_whose_numbers_are_of_unlike_length_are_remarked_on(tmp_path):
    poses = PoseSequence(np.zeros((3, 55, 3)), np.zeros((3, 3)), fps=1.0)
    scans = [_scan(name=f"scan_{i}") for i in (9, 10, 11)]
    (finding,) = [f for f in check_set(write_scan_set(tmp_path / "set", scans, "set", poses)) if "order" in f.message]
    assert not finding.severe and "the order scan_10, scan_11, scan_9 ...; write numbers" in finding.message
    padded = [_scan(name=f"scan_{i:02}") for i in (9, 10, 11)]
    findings = check_set(write_scan_set(tmp_path / "padded", padded, "set", poses))
    assert not [f for f in findings if "order" in f.message]


def test_labels_that_are_not_asked_for_refuse_no_scan(tmp_path, capsys):
    """Empty ones, and a PLY's property called label that means something else, where colours are to be gone by."""
    scans = [_scan(name=f"s{i}", labels=np.full(len(_person()[0]), 255, np.uint8)) for i in range(3)]
    folder = _set(tmp_path / "set", scans).folder
    with pytest.raises(CaphyError, match="no scan"):
        check_scans(folder, tmp_path / "run", None)
    check_scans(folder, tmp_path / "run", "colour")
    assert "3 of 3 scans can be used" in capsys.readouterr().out
    for scan in scans:
        write_ply(folder / f"{scan.name}.ply", MeshFile(scan.vertices, scan.faces, scan.colours, 0 * scan.labels + 7))
    main(["segment", str(folder), "--parser", "colour"])
    assert "labels must be" not in "".join(capsys.readouterr())


def test_somebody_of_another_size_is_remarked_on(tmp_path):
    scans = [_scan(name=f"s{i}") for i in range(5)] + [_scan(name="child", vertices=0.75 * _person()[0])]
    findings = check_set(_set(tmp_path / "set", scans))
    assert [f.scan for f in findings] == ["child"]
    assert "is it another person" in findings[0].message


def test_a_set_that_lies_is_asked_for_its_up_axis(tmp_path):
    lying = _person()[0] @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # y to z
    _set(tmp_path / "set", [_scan(name=f"s{i}", vertices=lying) for i in range(2)])
    findings = check_set(ScanSet.read(tmp_path / "set"))
    assert len(findings) == 2
    assert 'try up_axis = "z" or "-z"' in findings[0].message


def test_a_set_on_its_head_is_asked_for_its_up_axis(tmp_path):
    vertices = _person()[0] * [1, -1, -1]
    _set(tmp_path / "set", [_scan(name=f"s{i}", vertices=vertices) for i in range(3)])
    findings = check_set(ScanSet.read(tmp_path / "set"))
    assert [finding.scan for finding in findings] == ["s0", "s1", "s2"]
    assert 'stand on its head: its upper end spreads like feet; try up_axis = "-y"' in findings[0].message
    assert not any(finding.severe for finding in findings)


def test_that_axis_is_the_upward_one_also_where_arms_spread_wider_than_the_person_is_tall(tmp_path):
    vertices = _person()[0] * [1.6, -1, -1]
    assert np.ptp(vertices[:, 0]) > np.ptp(vertices[:, 1]) > 0.75 * np.ptp(vertices[:, 0])
    _set(tmp_path / "set", [_scan(name=f"s{i}", vertices=vertices) for i in range(3)])
    findings = check_set(ScanSet.read(tmp_path / "set"))
    assert [f.message.rsplit(" ", 1)[1] for f in findings if "on its head" in f.message] == 3 * ['"-y"']


def test_one_that_lies_among_others_that_stand_is_named(tmp_path):
    lying = _person()[0] @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    scans = [_scan(name=f"s{i}") for i in range(4)] + [_scan(name="z_up", vertices=lying)]
    findings = check_set(_set(tmp_path / "set", scans))
    assert [finding.scan for finding in findings] == ["z_up"]
    assert "seems to lie, and the others stand" in findings[0].message


def test_an_unreadable_scan_costs_only_itself(tmp_path):
    scans = _set(tmp_path / "set", [_scan(name=f"s{i}") for i in range(3)])
    scans.files[1].write_bytes(b"ply\nnonsense")
    findings = check_set(scans)
    assert [(f.scan, f.severe) for f in findings] == [("s1", True)]
    assert usable(scans, findings) == [0, 2]


def test_a_set_without_a_usable_scan_is_an_error(tmp_path):
    scans = _set(tmp_path / "set", [_scan(name="only", labels=np.zeros(len(_person()[0]), np.uint8))])
    with pytest.raises(CaphyError, match="no scan can be used; the first: only: shows no clothes"):
        usable(scans, check_set(scans))
