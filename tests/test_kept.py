"""What is kept is told from everything else, and found again as it was."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from caphy.commands.unfinished import unfinished
from caphy.errors import CaphyError
from caphy.kept import Kept, digest


@dataclass(frozen=True)
class Pair:
    one: object
    other: object


def test_a_digest_tells_every_content_from_every_other() -> None:
    ones = np.ones(6)
    told = [
        None, 0, 1, 1.0, True, "1", b"1", (), (1,), [1], (1, 1), ((1,), 1), (1, (1,)), {"a": 1}, {"a": 2}, {"b": 1},
        {"a": 1, "b": 1}, frozenset({"a"}), frozenset({"a", "b"}), ones, ones.astype(np.float32), ones.reshape(2, 3),
        ones.reshape(3, 2), np.float64(1), Pair(1, 2), Pair(2, 1), Pair("ab", "c"), Pair("a", "bc"), Path("1"),
        {"a": {"b": 1}, "c": 2}, {"a": {"b": 1, "c": 2}},
    ]  # fmt: skip
    assert len({digest(value) for value in told}) == len(told)
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})
    assert digest(ones[::2]) == digest(np.ones(3))
    with pytest.raises(TypeError, match="function"):
        digest(lambda: 0)


def test_a_digest_is_the_same_in_every_process() -> None:
    """Words are hashed otherwise in each of them."""
    line = "from caphy.kept import digest; print(digest(frozenset(['solver', 'start', 'mesh']), {'a': 1.5}))"
    told = {
        subprocess.run(
            [sys.executable, "-c", line], env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert len(told) == 1


def test_half_a_file_and_another_effect_s_code_are_not_recalled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    effect = tmp_path / "mine.py"
    effect.write_text("one")
    kept = Kept(tmp_path / "kept", [effect])
    key = kept.key("something", 1)
    assert kept.recall(key) is None
    kept.keep(key, {"values": np.arange(1000.0)})
    np.testing.assert_array_equal(kept.recall(key)["values"], np.arange(1000.0))
    effect.write_text("other")
    assert Kept(tmp_path / "kept", [effect]).key("something", 1) != key
    effect.write_text("one")
    assert Kept(tmp_path / "kept", [effect]).key("something", 1) == key
    (tmp_path / "helper.py").write_text("FACTOR = 2")
    assert Kept(tmp_path / "kept", [effect]).key("something", 1) != key
    (file,) = (tmp_path / "kept").iterdir()
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert kept.recall(key) is None
    full = Kept(effect)  # no folder can be made there, as on a full disk
    for _ in range(2):
        full.keep("key", {"values": np.zeros(1)})
    assert capsys.readouterr().err.count("unfinished work cannot be kept there") == 1
    assert full.recall("key") is None
    nowhere = Kept()
    nowhere.keep("key", {"values": np.zeros(1)})
    assert nowhere.recall("key") is None


def test_what_is_unfinished_stays_until_it_is_done(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "unfinished"
    with pytest.raises(KeyboardInterrupt), unfinished(folder) as kept:
        kept.mkdir()
        Kept(kept).keep("0" * 64, {})
        raise KeyboardInterrupt
    assert f"stopped; the same command goes on from {folder}" in capsys.readouterr().err
    with pytest.raises(OSError, match="full"), unfinished(folder):
        raise OSError("the disk is full")
    assert folder.is_dir()
    capsys.readouterr()
    with unfinished(folder):
        assert (
            f"{folder} holds what an earlier run left; what was found from the same is not done again"
            in capsys.readouterr().out
        )
    assert not folder.exists()
    with unfinished(folder):
        pass
    assert not capsys.readouterr().out
    folder.mkdir()
    (folder / "thesis.txt").write_text("mine")
    with pytest.raises(CaphyError, match="holds 'thesis"), unfinished(folder):
        pass
    assert (folder / "thesis.txt").read_text() == "mine"


@pytest.mark.parametrize("name", ["0" * 64, f"square-held_out-3-{'a' * 20}"])
def test_what_a_kill_left_half_written_neither_stops_nor_outlives_the_work(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "unfinished"
    line = (
        "import os, sys; from pathlib import Path; from caphy.io.places import new_file\n"
        "with new_file(Path(sys.argv[1])) as file: file.write(b'half'); file.flush(); os.kill(os.getpid(), 9)"
    )
    assert subprocess.run([sys.executable, "-c", line, str(folder / f"{name}.npz")], check=False).returncode == -9
    assert len(list(folder.iterdir())) == 1
    with unfinished(folder) as kept:
        Kept(kept).keep("1" * 64, {})
    assert not folder.exists()
