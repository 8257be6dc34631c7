"""Sealed answers open as they were closed, and only so."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest

from caphy.challenge.sealed import NAME, opened, seal
from caphy.cli import main
from caphy.commands.challenge import New, _is_there, verdict
from caphy.errors import CaphyError

ANSWER = {"hidden": "pressure", "effects": {"pressure": {"pressure": 0.2}}, "outside": None, "verdict": "named",
          "alike": {"pressure": ["wind_normal"]}}  # fmt: skip


def test_an_answer_comes_back_and_its_text_does_not_show_it(tmp_path):
    text, digest = seal(ANSWER)
    assert "pressure" not in text
    assert digest in text
    assert seal(ANSWER)[1] != digest  # the salt
    (tmp_path / NAME).write_text(text)
    assert opened(tmp_path) == (ANSWER, digest)


def test_a_changed_answer_is_refused(tmp_path):
    document = json.loads(seal(ANSWER)[0])
    document["sealed"] = json.loads(seal({**ANSWER, "hidden": "gust"})[0])["sealed"]
    (tmp_path / NAME).write_text(json.dumps(document))
    with pytest.raises(CaphyError, match="does not match its hash"):
        opened(tmp_path)


@pytest.mark.parametrize("missing", ["sha256", "sealed", "effects"])
def test_an_answer_with_something_missing_is_told(tmp_path, missing, capsys):
    document = json.loads(seal({key: value for key, value in ANSWER.items() if key != missing})[0])
    document.pop(missing, None)
    (tmp_path / NAME).write_text(json.dumps(document))
    assert main(["challenge", "reveal", str(tmp_path)]) == 2
    assert f"no sealed answer of a challenge: KeyError('{missing}')" in capsys.readouterr().err


def test_the_hash_is_said_again(tmp_path, capsys):
    """Whoever seals another answer has another hash."""
    text, digest = seal(ANSWER)
    (tmp_path / NAME).write_text(text)
    assert main(["challenge", "reveal", str(tmp_path)]) == 0
    assert f"SHA-256 {digest}" in capsys.readouterr().out


def test_a_missing_answer_says_how_to_make_one(tmp_path, capsys):
    assert main(["challenge", "reveal", str(tmp_path)]) == 2
    assert "caphy challenge new" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("found", "word"),
    [
        (["pressure"], "right"),
        (["wind_normal"], "near"),
        (["pressure", "wind_normal"], "near"),
        (["gust"], "wrong"),
        ([], "wrong"),
        (["pressure", "gust"], "wrong: missed nothing; named without reason: gust"),
    ],
)
def test_verdicts(found, word):
    assert verdict(ANSWER, {"verdict": "named", "found": found}).startswith(word)


@pytest.mark.parametrize("text", ["{", "[]", '{"verdict": "named"}', '{"verdict": "named", "found": [{"of": 1}]}'])
def test_what_is_no_diagnosis_is_told(tmp_path, capsys, text):
    (tmp_path / NAME).write_text(seal(ANSWER)[0])
    (tmp_path / "diagnosis").mkdir()
    (tmp_path / "diagnosis" / "diagnosis.json").write_text(text)
    assert main(["challenge", "reveal", str(tmp_path)]) == 2
    assert "is no diagnosis of such measurements; run 'caphy diagnose' again" in capsys.readouterr().err
    (tmp_path / "diagnosis" / "diagnosis.json").write_text('{"verdict": "named", "found": ["pressure"]}')
    assert main(["challenge", "reveal", str(tmp_path)]) == 0
    assert "diagnosis: named, pressure\n  right" in capsys.readouterr().out


def test_an_earlier_diagnosis_is_not_judged_by_a_new_challenge(tmp_path, capsys):
    (tmp_path / "diagnosis").mkdir()
    assert main(["challenge", "new", "--seed", "1", "-o", str(tmp_path)]) == 2
    assert "belongs to another challenge" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["diagnosis"]


def test_the_same_challenge_made_again_keeps_its_diagnosis(tmp_path):
    this = New(seed=1, output=tmp_path)
    assert not _is_there(this)
    text, _ = seal({**ANSWER, "seed": 1, "scene": "square", "noise_mm": 1.0, "points": None})
    (tmp_path / NAME).write_text(text)
    assert _is_there(this)
    for other in (replace(this, seed=2), replace(this, points=2500), replace(this, scene="skirt")):
        assert not _is_there(other)


def test_what_is_simulated_is_counted_in_motions(tmp_path, capsys, monkeypatch):
    def made(*_, progress, **__):
        progress(1, 9)
        raise CaphyError("enough")

    monkeypatch.setattr("caphy.challenge.world.make", made)
    assert main(["challenge", "new", "--seed", "1", "-o", str(tmp_path / "new")]) == 2
    said = capsys.readouterr().err
    assert "motion/s" in said and "window" not in said


def test_the_same_challenge_made_again_keeps_its_hash(tmp_path, capsys, monkeypatch):
    """A salt that changes would change what was printed when the challenge was made."""
    truth = {**ANSWER, "seed": 1, "scene": "square", "noise_mm": 1.0, "points": None}
    answers = iter([truth, truth, {**truth, "hidden": "gust"}])
    model = SimpleNamespace(to_json=lambda: "{}")
    monkeypatch.setattr(
        "caphy.challenge.world.make", lambda *_, **__: SimpleNamespace(
            train=(), base=(), held_out=(), model=model, answer=next(answers))
    )  # fmt: skip
    told = []
    for _ in range(3):
        assert main(["challenge", "new", "--seed", "1", "-o", str(tmp_path)]) == 0
        told.append(re.findall("SHA-256 (.*)", capsys.readouterr().out)[0])
        assert opened(tmp_path)[1] == told[-1]
    assert told[0] == told[1] != told[2]


def test_clouds_hold_points_enough_to_be_registered(tmp_path, capsys):
    assert main(["challenge", "new", "--seed", "1", "--points", "49", "-o", str(tmp_path / "new")]) == 2
    assert "--points must be 50 or more, without which a frame counts as missing, got 49" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_noise_must_be_a_number(tmp_path, capsys):
    assert main(["challenge", "new", "--seed", "1", "--noise", "nan", "-o", str(tmp_path)]) == 2
    assert "must not be negative, got 1 and nan" in capsys.readouterr().err


def test_a_model_of_ones_own_is_not_written_over(tmp_path, capsys):
    (tmp_path / "model.json").write_text("mine")
    assert main(["challenge", "new", "--seed", "3", "-o", str(tmp_path)]) == 2
    assert "holds a model.json that is no challenge's" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["model.json"]
