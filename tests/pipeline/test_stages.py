"""Stages are done once for the same input, go on where they were stopped, and never mix what belongs to other input."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from caphy import kept
from caphy.errors import CaphyError
from caphy.pipeline.runner import Pace, run_stages
from caphy.pipeline.stage import Stage, fingerprint


class Work:
    """Two stages: letters of a file, one file each, and their number; counts how often each is run."""

    def __init__(self, folder: Path, text: str = "abc") -> None:
        self.folder, self.source, self.runs = folder, folder / "source.txt", []
        self.source.write_text(text)
        self.stop_after: int | None = None
        self.big = False

    def letters(self) -> None:
        self.runs.append("letters")
        out = self.folder / "letters"
        out.mkdir(exist_ok=True)
        for number, letter in enumerate(self.source.read_text()):
            if number == self.stop_after:
                raise KeyboardInterrupt
            if not (out / f"{number}.txt").exists():
                print(f"wrote {letter}")
                # As all of caphy writes: a file that is there is whole, also for who kills this once it is seen.
                partial = out / f"{number}.txt.partial"
                partial.write_text(letter.upper() if self.big else letter)
                partial.replace(out / f"{number}.txt")

    def count(self) -> None:
        self.runs.append("count")
        (self.folder / "count.txt").write_text(str(len(list((self.folder / "letters").iterdir()))))

    def stages(self) -> list[Stage]:
        letters, count = self.folder / "letters", self.folder / "count.txt"
        return [
            Stage("letters", "writing", self.letters, (self.source,), (letters,), {"big": self.big}),
            Stage("count", "counting", self.count, (letters,), (count,)),
        ]

    def run(self):
        said = []
        return run_stages(self.stages(), self.folder, said.append), said


@pytest.fixture
def work(tmp_path):
    return Work(tmp_path)


def test_what_is_done_is_not_done_again(work):
    first, _ = work.run()
    assert first.done == ["letters", "count"] and (work.folder / "count.txt").read_text() == "3"
    again, said = work.run()
    assert again.kept == ["letters", "count"] and work.runs == ["letters", "count"]
    assert said == ["[1 of 2] writing: done before", "[2 of 2] counting: done before"]


def test_what_other_code_did_is_kept_and_said(work, monkeypatch):
    """Hours of training are not thrown away for a line of code; who wants them by the new one is told how."""
    work.run()
    monkeypatch.setattr("caphy.pipeline.runner.own_code", lambda: "changed")
    again, said = work.run()
    assert again.kept == ["letters", "count"] and work.runs == ["letters", "count"]
    assert all(re.search("done before, by other code of caphy.*another folder", line) for line in said)


def test_what_was_done_on_other_bundled_data_is_kept_and_said(work, tmp_path, monkeypatch):
    """Trainings begin as the default avatar, which is no code; here a copy of what comes along takes its place."""
    package = tmp_path / "caphy"
    shutil.copytree(kept.PACKAGE / "data" / "avatars", package / "data" / "avatars")
    monkeypatch.setattr(kept, "PACKAGE", package)
    try:
        kept.own_code.cache_clear()
        work.run()
        assert not any("other data" in line for line in work.run()[1])
        graph = package / "data" / "avatars" / "default" / "tshirt.onnx"
        content = bytearray(graph.read_bytes())
        content[len(content) // 2] ^= 1
        graph.write_bytes(content)
        kept.own_code.cache_clear()  # as in another process
        again, said = work.run()
        assert again.kept == ["letters", "count"]
        assert all(re.search("done before, by other code of caphy or on other data", line) for line in said)
    finally:
        kept.own_code.cache_clear()


def test_changed_input_is_done_anew_without_what_was_left(work):
    work.run()
    work.source.write_text("xy")
    outcome, said = work.run()
    assert outcome.done == ["letters", "count"]
    assert f"  made anew, and what it left before removed, for {work.source} is not as before" in said
    assert sorted(path.read_text() for path in (work.folder / "letters").iterdir()) == ["x", "y"]
    assert (work.folder / "count.txt").read_text() == "2"


def test_the_same_content_written_again_is_no_change(work):
    work.run()
    work.source.write_text("abc")
    os.utime(work.source, (1, 1))
    assert work.run()[0].kept == ["letters", "count"]


def test_only_what_depends_on_a_change_is_done_anew(work):
    work.run()
    (work.folder / "letters" / "0.txt").write_text("z")  # by hand: the stage that wrote it is content
    assert work.run()[0].done == ["count"]
    work.big = True
    outcome, said = work.run()
    assert outcome.done == ["letters", "count"]
    assert "  made anew, and what it left before removed, for the option big is not as before" in said
    assert (work.folder / "letters" / "0.txt").read_text() == "A"


def test_a_missing_output_is_made_again(work):
    work.run()
    (work.folder / "count.txt").unlink()
    assert work.run()[0].done == ["count"]
    assert (work.folder / "count.txt").read_text() == "3"


def test_a_stopped_stage_goes_on_with_what_it_left(work):
    work.stop_after = 2
    with pytest.raises(KeyboardInterrupt):
        work.run()
    work.stop_after = None
    outcome, _ = work.run()
    assert outcome.done == ["letters", "count"]
    assert (work.folder / "stages" / "letters.log").read_text().split() == ["wrote", "a", "wrote", "b", "wrote", "c"]


def test_a_stopped_stage_starts_anew_if_its_input_changed_meanwhile(work):
    work.stop_after = 2
    with pytest.raises(KeyboardInterrupt):
        work.run()
    work.stop_after = None
    work.source.write_text("xbc")
    _, said = work.run()
    assert f"  made anew, and what it left before removed, for {work.source} is not as before" in said
    assert (work.folder / "letters" / "0.txt").read_text() == "x"


def test_killed_while_former_outputs_go_what_is_left_of_them_does_not_count(work, monkeypatch):
    work.run()

    def killed(path: Path) -> None:
        (path / "0.txt").unlink()
        raise KeyboardInterrupt

    work.big = True
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("caphy.pipeline.ledger._remove", killed)
        work.run()
    work.big = False
    assert work.run()[0].done[0] == "letters"
    assert sorted(path.read_text() for path in (work.folder / "letters").iterdir()) == ["a", "b", "c"]


def test_a_damaged_record_counts_as_none(work):
    work.run()
    (work.folder / "stages" / "letters.json").write_text('{"key": ')
    assert work.run()[0].done == ["letters"]


def test_a_failure_names_stage_and_log_and_keeps_what_was_done(work):
    def fail() -> None:
        raise CaphyError("scan_003.ply: has no labels")

    stages = [work.stages()[0], Stage("broken", "breaking", fail)]
    with pytest.raises(CaphyError, match=r"stage broken: scan_003\.ply: has no labels\n.*is kept.*broken\.log"):
        run_stages(stages, work.folder, lambda line: None)
    assert "has no labels" in (work.folder / "stages" / "broken.log").read_text()
    assert run_stages(work.stages(), work.folder, lambda line: None).kept == ["letters"]


def test_what_may_fail_does_not_stop_the_rest(work):
    def fail() -> None:
        raise CaphyError("no weights")

    stages = [Stage("extra", "more", fail, may_fail=True), *work.stages()]
    outcome = run_stages(stages, work.folder, lambda line: None)
    assert outcome.failed == {"extra": "no weights"} and outcome.done == ["letters", "count"]
    assert run_stages(stages, work.folder, lambda line: None).failed == {"extra": "no weights"}  # tried again


def test_a_stage_that_does_not_write_what_it_should_has_failed(work):
    with pytest.raises(CaphyError, match="did not write"):
        run_stages([Stage("idle", "idling", lambda: None, outputs=(work.folder / "none",))], work.folder, print)


def test_estimates_follow_the_machine_but_not_a_time_that_was_asked_for():
    slow, asked = Stage("a", "", lambda: None, seconds=300), Stage("b", "", lambda: None, seconds=600, timed=True)
    pace = Pace()
    assert pace.left([slow, asked]) == pytest.approx(900)
    pace.add(slow, 600)
    pace.add(asked, 6000)
    assert pace.left([asked]) == pytest.approx(600)
    assert 450 < pace.left([slow]) < 600


def test_fingerprints_tell_contents_and_names_not_what_is_being_written(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "one.npz").write_bytes(b"1")
    before = fingerprint(tmp_path / "a")
    for stray in ("two.npz.partial", ".DS_Store", "._one.npz", "Thumbs.db"):  # where somebody has looked
        (tmp_path / "a" / stray).write_bytes(b"half")
        assert fingerprint(tmp_path / "a") == before
    (tmp_path / "a" / "one.npz").rename(tmp_path / "a" / "other.npz")
    assert fingerprint(tmp_path / "a") != before
    assert fingerprint(tmp_path / "none") == "missing"


def test_fingerprints_go_through_linked_folders_but_not_round_in_circles(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "set" / "labels").symlink_to(tmp_path / "elsewhere")
    before = fingerprint(tmp_path / "set")
    (tmp_path / "elsewhere" / "a.npy").write_bytes(b"1")
    after = fingerprint(tmp_path / "set")
    assert after != before
    (tmp_path / "set" / "self").symlink_to(tmp_path / "set")
    assert fingerprint(tmp_path / "set") == after
    (tmp_path / "set" / "labels").unlink()
    (tmp_path / "elsewhere").rename(tmp_path / "set" / "labels")
    assert fingerprint(tmp_path / "set") == after  # the same content in a folder of its own


KILLED = """
import sys, time
sys.path.insert(0, {here!r})
from pathlib import Path
from test_stages import Work
work = Work(Path(sys.argv[1]), "abcdef")
letters = work.letters
def slow():
    work.stop_after = 3
    try:
        letters()
    except KeyboardInterrupt:
        time.sleep(600)
work.letters = slow
work.run()
"""


def test_killed_and_run_again_equals_uninterrupted(tmp_path):
    for name in ("whole", "broken"):
        (tmp_path / name).mkdir()
    whole = Work(tmp_path / "whole", "abcdef")
    whole.run()
    code = KILLED.format(here=str(Path(__file__).parent))
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "broken")])
    last, deadline = tmp_path / "broken" / "letters" / "2.txt", time.monotonic() + 120
    while not last.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    broken = Work(tmp_path / "broken", "abcdef")
    assert json.loads((broken.folder / "stages" / "letters.json").read_text())["finished"] is False
    outcome, _ = broken.run()
    assert outcome.done == ["letters", "count"]
    for name in ("letters", "count.txt"):
        assert fingerprint(broken.folder / name) == fingerprint(whole.folder / name)


def test_what_the_run_did_not_make_is_left_alone(work):
    theirs = work.folder / "letters" / "mine.txt"
    theirs.parent.mkdir()
    theirs.write_text("by hand")
    with pytest.raises(CaphyError, match="letters: is there already and not of this run"):
        work.run()
    assert theirs.read_text() == "by hand" and not work.runs


def test_what_is_missing_beyond_the_outputs_is_made_again(work):
    more = work.folder / "more.txt"

    def make() -> None:
        work.count()
        more.write_text("")

    stage = Stage("count", "counting", make, (work.source,), (work.folder / "count.txt",), whole=more.exists)
    (work.folder / "letters").mkdir()
    run_stages([stage], work.folder, lambda line: None)
    more.unlink()
    assert run_stages([stage], work.folder, lambda line: None).done == ["count"] and more.exists()
    broken = replace(stage, run=work.count)
    more.unlink()
    with pytest.raises(CaphyError, match=r"count: did not write all that belongs to .*count\.txt"):
        run_stages([broken], work.folder, lambda line: None)


def test_a_renamed_input_is_the_same_input(work):
    work.run()
    work.source = work.source.rename(work.folder / "renamed.txt")
    assert work.run()[0].kept == ["letters", "count"]


def test_what_an_earlier_caphy_began_is_not_removed(work):
    """Its keys say nothing of inputs now, and all outputs would go as if these had changed."""
    work.run()
    for record in (work.folder / "stages").glob("*.json"):
        told = json.loads(record.read_text())
        assert told.pop("scheme") == 2
        record.write_text(json.dumps(told))
    with pytest.raises(CaphyError, match=r"was begun by an earlier caphy.*\(letters, count\).*another folder"):
        work.run()
    assert (work.folder / "count.txt").read_text() == "3" and work.runs == ["letters", "count"]


def test_what_follows_from_a_changed_input_is_in_the_estimate(work):
    """It was done before, but will be done again."""
    told = [replace(stage, seconds=seconds) for stage, seconds in zip(work.stages(), (60, 6000), strict=True)]
    run_stages(told, work.folder, lambda line: None)
    work.source.write_text("xy")
    said = []
    run_stages(told, work.folder, said.append)
    assert "about 60 s, 101 min for all that is left" in said[0]


def test_what_tells_of_all_is_gone_while_another_is_not_done(work):
    """A page of an earlier run would be taken for this one's."""
    page = work.folder / "page.html"
    made = work.stages
    work.stages = lambda: [
        *made(),
        Stage("page", "telling", lambda: page.write_text(work.source.read_text()), (), (page,), of_all=True),
    ]
    work.run()
    assert page.read_text() == "abc" and work.run()[0].done == []
    work.source.write_text("xyz")
    work.stop_after = 1
    with pytest.raises(KeyboardInterrupt):
        work.run()
    assert not page.exists()
    work.stop_after = None
    assert work.run()[0].done == ["letters", "count", "page"] and page.read_text() == "xyz"
