"""Places that cannot be written are told before the work, and nothing is left behind by asking."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from caphy.capture import session
from caphy.cli import main
from caphy.commands import onward
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.io.places import writable_file, writable_folder, write_text
from caphy.scan.scan_set import write_scan_set
from caphy.training.loop import forget_later


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


@pytest.mark.parametrize(
    ("name", "former", "write"),
    [
        ("truth/plan.json", None, lambda folder: session._claim(session.Plan(), folder, folder / "truth")),
        ("truth/subject.json", None, lambda folder: session._subject(session.Plan(), folder / "truth")),
        ("scans.toml", None, lambda folder: write_scan_set(folder, [], "somebody")),
        ("metrics.jsonl", '{"step": 1}\n{"step": 2}\n', lambda folder: forget_later(folder / "metrics.jsonl", 1)),
        ("run.json", '{"steps": 5}', lambda folder: onward._record(folder, folder, Model(0.2), {"steps": 1})),
        ("model.json", None, lambda folder: onward._record(folder, folder, Model(0.2), {"steps": 1})),
    ],
)
def test_killed_amid_a_small_file_there_is_the_former_or_none(name, former, write, tmp_path, monkeypatch):
    """The plan of a session, its subject, a set's description, a training's metrics and records."""

    class Killed(BaseException):
        pass

    def half(path: Path, text: str, **_) -> None:
        path.write_bytes(text.encode()[: len(text) // 2])
        raise Killed

    def killed(*_) -> None:
        raise Killed

    if former is not None:
        (tmp_path / name).write_text(former)
    monkeypatch.setattr(session, "make_subject", lambda *_: None)
    monkeypatch.setattr(session, "_write_subject", lambda *_: None)
    monkeypatch.setattr(session, "_told", lambda _: {"garments": {}})
    monkeypatch.setattr(Path, "write_text", half)
    monkeypatch.setattr(os, "replace", killed)
    (tmp_path / "truth").mkdir()
    with pytest.raises(Killed):
        write(tmp_path)
    assert ((tmp_path / name).read_text() if (tmp_path / name).exists() else None) == former


def test_half_a_plan_of_a_session_is_told(tmp_path):
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "plan.json").write_text('{"seed":')
    with pytest.raises(CaphyError, match=r"plan\.json: .*delete"):
        session._claim(session.Plan(), tmp_path, tmp_path / "truth")


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
        ["export", "default", "--format", "usd", "--poses", "walk.npz", "-o", "file/walk.usdc"],
        ["export", "default", "--format", "glb", "--poses", "walk.npz", "-o", "/proc/walk.glb"],
        ["export", "default", "--format", "pc2", "--poses", "walk.npz", "-o", "file"],
    ],
)
def test_commands_refuse_them_in_words(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    np.savez(tmp_path / "walk.npz", poses=np.zeros((9, 165)), trans=np.zeros((9, 3)), mocap_frame_rate=30.0)
    assert main(arguments) == 2
    assert "choose another place" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["poses", "render", "walk.npz", "--out", "sheet.jpg"],
        ["body", "render", "--out", "sheet.jpg"],
        ["garment", "render", "snug.npz", "-o", "walk.npz"],
        ["scans", "render", "scans", "--output", "walk.npz"],
        ["segment", "scans", "--render", "walk.npz"],
        ["simulate", "tshirt", "walk.npz", "--render", "walk.npz"],
    ],
)
def test_pictures_have_a_pngs_name(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "walk.npz", poses=np.zeros((9, 165)), trans=np.zeros((9, 3)), mocap_frame_rate=30.0)
    before = sorted(tmp_path.rglob("*")), (tmp_path / "walk.npz").read_bytes()
    assert main(arguments) == 2
    assert "must end in .png" in capsys.readouterr().err
    assert (sorted(tmp_path.rglob("*")), (tmp_path / "walk.npz").read_bytes()) == before


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
