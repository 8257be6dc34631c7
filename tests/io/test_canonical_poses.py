"""Caphy's own pose file: nothing is lost, nothing is pickled, nothing is half written."""

import json
import os
import zipfile

import numpy as np
import pytest

from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence, read_poses, write_poses


def made(**fields) -> PoseSequence:
    rng = np.random.default_rng(2)
    start = {"poses": rng.normal(0, 1, (5, 55, 3)), "transl": rng.normal(0, 1, (5, 3)), "fps": 59.94, "source": "é.bvh"}
    return PoseSequence(
        **{**start, "betas": rng.normal(0, 1, 10), "frame": "camera", "notes": ("one", "two"), **fields}
    )


@pytest.mark.parametrize("fields", [{}, {"betas": None}, {"model": "smplh", "pelvis": (0.0, 0.1, 0.2)}])
def test_comes_back_as_it_was(tmp_path, fields):
    before = made(**fields)
    write_poses(before, tmp_path / "a.npz")
    after = read_poses(tmp_path / "a.npz")
    for name in ("poses", "transl", "pelvis"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    for name in ("fps", "up_axis", "frame", "model"):
        assert getattr(after, name) == getattr(before, name)
    assert after.source == str(tmp_path / "a.npz")  # what is wrong from here on is wrong in that file
    assert after.notes == (*before.notes, f"made from {before.source}")
    assert (after.betas is None) == (before.betas is None)


def test_frames_that_nobody_saw_come_back(tmp_path):
    write_poses(made(unseen=np.array([False, True, False, False, True])), tmp_path / "a.npz")
    assert read_poses(tmp_path / "a.npz").unseen.tolist() == [False, True, False, False, True]
    write_poses(made(), tmp_path / "b.npz")
    assert read_poses(tmp_path / "b.npz").unseen is None


def test_a_rate_that_is_given_replaces_the_file_s_and_is_noted(tmp_path):
    write_poses(made(notes=(), source=""), tmp_path / "a.npz")
    assert read_poses(tmp_path / "a.npz", fps=25.0).fps == 25.0
    assert read_poses(tmp_path / "a.npz", fps=25.0).notes == ("frame rate 25 replaces the file's 59.94",)
    assert read_poses(tmp_path / "a.npz", fps=59.94).notes == ()
    with pytest.raises(CaphyError, match="says that y is up, which stands; got up = 'z'"):
        read_poses(tmp_path / "a.npz", up="z")


def test_says_what_its_numbers_mean(tmp_path):
    write_poses(made(), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:  # plain arrays only
        header = json.loads(str(file["header"]))
        assert all(file[name].dtype.kind in "fU" for name in file.files)
    assert header["units"] == {"poses": "rad, axis-angle", "transl": "m", "pelvis": "m", "fps": "Hz"}
    assert tuple(header["joints"]) == JOINT_NAMES
    assert header["version"] == 1


def test_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    write_poses(made(), tmp_path / "a.npz")
    before = (tmp_path / "a.npz").read_bytes()

    def fails(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fails)
    with pytest.raises(CaphyError, match=r"cannot be written \(disk full\); free space"):
        write_poses(made(), tmp_path / "a.npz")
    assert (tmp_path / "a.npz").read_bytes() == before
    assert os.listdir(tmp_path) == ["a.npz"]
    with pytest.raises(CaphyError, match="cannot be written"):
        write_poses(made(), tmp_path / "a.npz" / "b.npz")
    with pytest.raises(CaphyError, match=r"\.npz"):
        write_poses(made(), tmp_path / "a.pkl")


def test_cut_and_spoilt_files_are_refused(tmp_path):
    write_poses(made(), tmp_path / "a.npz")
    whole = (tmp_path / "a.npz").read_bytes()
    for length in (0, 1, 10, len(whole) // 2, len(whole) - 5):
        (tmp_path / "b.npz").write_bytes(whole[:length])
        with pytest.raises(CaphyError, match=r"b\.npz"):
            read_poses(tmp_path / "b.npz")
    rng = np.random.default_rng(0)
    for _ in range(60):
        spoilt = bytearray(whole)
        for at in rng.integers(0, len(whole), 4):
            spoilt[at] ^= int(rng.integers(1, 256))
        (tmp_path / "b.npz").write_bytes(spoilt)
        try:
            read_poses(tmp_path / "b.npz")
        except CaphyError as error:
            assert "b.npz" in str(error)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "schema version must be 1, got 2"),
        ({"joints": ["pelvis"]}, "joints must be SMPL-X's 55"),
        ({"fps": "fast"}, "fps must be a number"),
        ({"notes": 3}, "header cannot be understood"),
    ],
)
def test_other_headers_are_refused(tmp_path, change, words):
    write_poses(made(), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        arrays = {name: file[name] for name in file.files}
    header = json.loads(str(arrays["header"])) | change
    np.savez(tmp_path / "b.npz", **{**arrays, "header": np.array(json.dumps(header))})
    with pytest.raises(CaphyError, match=words):
        read_poses(tmp_path / "b.npz")


def test_other_archives_are_refused(tmp_path):
    np.save(tmp_path / "plain.npy", np.zeros(3))
    (tmp_path / "plain.npy").rename(tmp_path / "plain.npz")
    with zipfile.ZipFile(tmp_path / "zip.npz", "w") as file:
        file.writestr("readme.txt", "no arrays")
    for name in ("plain", "zip"):
        with pytest.raises(CaphyError, match=f"{name}.npz"):
            read_poses(tmp_path / f"{name}.npz")
