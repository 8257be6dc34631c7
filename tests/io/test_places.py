"""Places that cannot be written are told before the work, and nothing is left behind by asking."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from caphy.cli import main
from caphy.errors import CaphyError
from caphy.io.places import writable_file, writable_folder, write_text


def test_places_that_can_be_written(tmp_path):
    assert writable_file(tmp_path / "new" / "a.npz") == tmp_path / "new" / "a.npz"
    assert writable_folder(tmp_path / "new" / "run") == tmp_path / "new" / "run"
    assert not list(tmp_path.iterdir())


def test_places_that_cannot(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CaphyError, match="is a folder"):
        writable_file(tmp_path)
    for ask in (writable_file, writable_folder):
        with pytest.raises(CaphyError, match="file is a file; choose another place"):
            ask(tmp_path / "file" / "below")
    with pytest.raises(CaphyError, match="cannot be written"):
        writable_folder(tmp_path / "file")


def test_devices_and_links_to_nothing_are_no_places(tmp_path):
    with pytest.raises(CaphyError, match="/dev/null: must be a file, and is a device"):
        writable_file(Path("/dev/null"))
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for ask, place in ((writable_folder, "link"), (writable_file, "link/a.json")):
        with pytest.raises(CaphyError, match="is a link to what is not there"):
            ask(tmp_path / place)


def test_a_text_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    write_text(tmp_path / "new" / "a.json", "first")
    monkeypatch.setattr("os.replace", _full)
    with pytest.raises(CaphyError, match=r"a\.json: cannot be written \(No space left on device\)"):
        write_text(tmp_path / "new" / "a.json", "second")
    assert [path.read_text() for path in (tmp_path / "new").iterdir()] == ["first"]


def _full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_an_argument_that_is_empty_is_no_place(capsys):
    assert main(["compare", "snug", "walk.npz", "-o", ""]) == 2
    assert "an argument is empty" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["simulate", "tshirt", "walk.npz", "-o", "file/out.npz"],
        ["garment", "make", "tshirt", "-o", "file/out.npz"],
        ["poses", "convert", "walk.npz", "--out", "file"],
        ["poses", "render", "walk.npz", "--out", "file/sheet.png"],
        ["demo", "--out", "file"],
        ["challenge", "new", "--seed", "1", "-o", "file"],
        ["compare", "snug", "walk.npz", "-o", "file"],
        ["diagnose", "snug", "walk.npz", "-o", "file"],
        ["train", "tshirt", "walk.npz", "-o", "file"],
    ],
)
def test_commands_refuse_them_in_words(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    np.savez(tmp_path / "walk.npz", poses=np.zeros((9, 165)), trans=np.zeros((9, 3)), mocap_frame_rate=30.0)
    assert main(arguments) == 2
    assert "choose another place" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "tshirt", "walk.npz", "--seconds", "-1"], "--seconds must be positive"),
        (["poses", "render", "walk.npz", "--frames", "0"], "--frames must be at least 1"),
        (["export", "avatar", "--poses", "walk.npz", "-o", "y"], "--format glb, usd, pc2 or obj"),
    ],
)
def test_numbers_and_options_that_mean_nothing(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "walk.npz", poses=np.zeros((9, 165)), trans=np.zeros((9, 3)), mocap_frame_rate=30.0)
    assert main(arguments) == 2
    assert words in capsys.readouterr().err
