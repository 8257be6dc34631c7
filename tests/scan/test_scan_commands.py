"""The commands: segment a session, go on where it stopped, leave out what cannot be read; check and convert."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from small_session import small_session

from caphy.cli import main
from caphy.scan.mesh_files import MeshFile, write_ply
from caphy.scan.scan import BODY, LOWER, UPPER
from caphy.scan.scan_set import ScanSet


@pytest.fixture
def scans(tmp_path):
    """A copy of three scans of the small session; the second is damaged."""
    folder = tmp_path / "scans"
    folder.mkdir()
    session = small_session() / "scans"
    for name in ("scan_000", "scan_001", "scan_002"):
        shutil.copy(session / f"{name}.ply", folder)
    (folder / "scan_001.ply").write_bytes(b"ply\nnonsense")
    (folder / "scans.toml").write_text('unit = "m"\nup_axis = "y"\n')
    return folder


def test_segment_leaves_out_what_it_cannot_read_and_resumes(scans, tmp_path, capsys):
    assert main(["segment", str(scans), "--render", str(tmp_path / "sheet.png")]) == 1
    said = capsys.readouterr().out
    assert "left out scan_001" in said
    assert "labels of 2 of 3 scans" in said
    assert (tmp_path / "sheet.png").stat().st_size > 10_000
    truth = np.load(small_session() / "truth" / "stills" / "scan_000.npz")["labels"]
    labels = ScanSet.read(scans)[0].labels
    assert (labels == truth).mean() > 0.85  # without poses: from height and colour alone
    stamp = (scans / "labels" / "scan_000.npy").stat().st_mtime_ns
    (scans / "labels" / "scan_002.npy").unlink()
    assert main(["segment", str(scans)]) == 1
    assert "labels of 2 of 3 scans" in capsys.readouterr().out
    assert (scans / "labels" / "scan_000.npy").stat().st_mtime_ns == stamp
    shutil.copy(small_session() / "scans" / "scan_001.ply", scans)
    assert main(["segment", str(scans)]) == 0
    assert "labels of 3 of 3 scans" in capsys.readouterr().out
    assert (scans / "labels" / "scan_000.npy").stat().st_mtime_ns != stamp  # colours are learnt of all three now


def test_a_folder_that_cannot_be_written_into_is_told_before_any_scan(scans, capsys):
    (scans / "labels").write_text("of somebody")
    assert main(["segment", str(scans)]) == 2
    told = capsys.readouterr()
    assert "labels: cannot be written" in told.err and "left out" not in told.out and "learning" not in told.out


def test_a_grey_scan_costs_only_itself(scans, capsys):
    """Its texture may have been lost; the others' colours are learned without it."""
    shutil.copy(small_session() / "scans" / "scan_001.ply", scans)
    grey = ScanSet.read(scans)[0]
    colours = np.full_like(grey.colours, 100)
    write_ply(scans / "scan_000.ply", MeshFile(grey.vertices, grey.faces, colours, None))
    assert main(["segment", str(scans)]) == 1
    said = capsys.readouterr().out
    assert "left out scan_000" in said and "all vertices have one colour" in said
    assert "labels of 2 of 3 scans" in said


def test_neither_segments_nor_registers_what_is_in_another_unit(scans, tmp_path, capsys):
    (scans / "scan_001.ply").unlink()
    (scans / "scans.toml").write_text('unit = "cm"\nup_axis = "y"\n')
    for command in (["segment", str(scans)], ["register", "body", str(scans), "-o", str(tmp_path / "run")]):
        assert main(command) == 2
        said = capsys.readouterr()
        assert "a person must measure 0.7 to 3.0 m across" in said.out + said.err


def test_labels_of_another_parser_or_another_scan_are_made_anew_and_those_by_hand_are_kept(scans, tmp_path, capsys):
    """First by labels that came with the scans, all wrong so that nothing else would make them; then by colours."""
    out, given = tmp_path / "made", ScanSet.read(scans)
    (scans / "scan_001.ply").unlink()
    for index in (0, 2):
        scan = given[index]
        labels = np.where(scan.vertices[:, 0] > 0, UPPER, LOWER).astype(np.uint8)
        write_ply(given.files[index], MeshFile(scan.vertices, scan.faces, scan.colours, labels))
    paths = [out / f"{name}.npy" for name in ("scan_000", "scan_002")]
    assert main(["segment", str(scans), "--out", str(out), "--parser", "labels"]) == 0
    before = [np.load(path) for path in paths]
    edited = np.where(before[1] == UPPER, BODY, before[1]).astype(np.uint8)
    np.save(paths[1], edited)
    capsys.readouterr()
    assert main(["segment", str(scans), "--out", str(out)]) == 0
    assert "did not make them, or they were edited since (scan_002); remove them" in capsys.readouterr().out
    truth = np.load(small_session() / "truth" / "stills" / "scan_000.npz")["labels"]
    coloured = np.load(paths[0])
    assert (coloured == truth).mean() > 0.85 > (before[0] == truth).mean()
    assert (np.load(paths[1]) == edited).all()
    part = given[2]  # what scan_000 is from now on
    write_ply(scans / "scan_000.ply", MeshFile(part.vertices, part.faces, part.colours, None))
    assert main(["segment", str(scans), "--out", str(out)]) == 0
    assert len(np.load(paths[0])) == len(part.vertices) != len(coloured)
    np.save(paths[1], edited + 0.5)  # no labels at all
    assert main(["segment", str(scans), "--out", str(out)]) == 0 and (np.load(paths[1]) == edited + 0.5).all()
    paths[1].unlink()
    assert main(["segment", str(scans), "--out", str(out)]) == 0 and paths[1].is_file()


def test_check_tells_which_scans_can_be_used(scans, capsys):
    assert main(["scans", "check", str(scans)]) == 1
    said = capsys.readouterr().out
    assert "refused: scan_001" in said
    assert "2 of 3 scans can be used" in said


def test_labels_that_are_not_there(scans, capsys):
    assert main(["segment", str(scans), "--parser", "labels"]) == 2
    assert "no scan could be segmented" in capsys.readouterr().err


def test_a_parser_that_is_not_there(scans, capsys):
    assert main(["segment", str(scans), "--parser", "nobody.onnx"]) == 2
    assert "there is no such file; give a human parser" in capsys.readouterr().err


def test_capture_needs_a_folder_of_poses(tmp_path, capsys):
    assert main(["capture-sim", str(tmp_path / "out"), "--poses", str(tmp_path / "none")]) == 2
    assert "--poses must be a folder" in capsys.readouterr().err


def test_labels_are_not_read_and_written_in_one_place(scans, tmp_path, capsys):
    assert main(["segment", str(scans)]) == 1
    assert main(["segment", str(scans), "--parser", "labels"]) == 2
    assert "give another folder to write into with -o" in capsys.readouterr().err
    assert main(["segment", str(scans), "--parser", "labels", "--out", str(tmp_path / "smoothed")]) == 1
    assert f"next: caphy register body {scans} --labels {tmp_path / 'smoothed'} -o run" in capsys.readouterr().out


def test_numbers_of_others_are_not_given_their_meaning_twice(scans, capsys):
    with (scans / "scans.toml").open("a") as file:
        file.write("label_numbers = {body = [0, 1, 2], upper = [3], lower = [4]}\n")
    assert main(["segment", str(scans)]) == 2
    assert "label_numbers of scans.toml would be applied" in capsys.readouterr().err
