"""A model's history: kept through files, shown, and no part of the physics."""

from __future__ import annotations

import json

import pytest

from caphy.cli import main
from caphy.effects.history import Revision
from caphy.effects.model import Model
from caphy.effects.presets import snug_model
from caphy.errors import CaphyError


def refitted() -> Model:
    base = snug_model()
    found = base.with_effect("air_drag_normal", coefficient=2.5).with_effect("bending", stiffness_weft=1e-5)
    found = found.revised(
        base,
        "refit on one walk",
        data=["walk"],
        error_before=0.0112,
        error_after=0.0048,
        floor=0.0021,
        date="2026-01-02",
    )
    return found.without_effect("attachment").revised(found, "the waistband slips", date="2026-01-03")


def test_a_revision_is_what_changed():
    first, second = refitted().history
    assert first.added == ("air_drag_normal",) and first.removed == ()
    assert first.parameters == {"bending.stiffness_weft": (3.96e-5, 1e-5), "air_drag_normal.coefficient": (None, 2.5)}
    assert (first.error_before, first.error_after, first.floor) == (0.0112, 0.0048, 0.0021)
    assert second.removed == ("attachment",) and second.parameters == {"attachment.stiffness": (1e6, None)}
    assert second.error_before is None and second.date == "2026-01-03"


def test_history_survives_files_and_further_changes(tmp_path):
    path = tmp_path / "model.json"
    path.write_text(refitted().to_json())
    read = Model.load(path)
    assert [entry.to_dict() for entry in read.history] == [entry.to_dict() for entry in refitted().history]
    assert read.with_effect("pressure").without_effect("gravity").history == read.history
    entry = json.loads(path.read_text())["history"][0]
    assert entry["held_out_error_mm"] == {"before": 11.2, "after": 4.8, "floor": 2.1}


def test_files_without_history_load():
    text = snug_model().to_json()
    assert "history" not in json.loads(text)
    assert Model.from_json(text).history == ()


def test_equality_is_of_the_physics():
    base = snug_model()
    assert base == snug_model() and base == Model.from_json(base.to_json())
    assert base.revised(base, "looked at it again") == base
    assert base != base.with_effect("bending", stiffness_weft=1e-5)
    assert base != base.without_effect("inertia")  # which has no parameters
    assert base != Model(0.3, base.effects)
    assert base != "snug"


@pytest.mark.parametrize(
    "entry",
    [
        "refit",
        {"note": "no date"},
        {**Revision("2026-01-01", "x").to_dict(), "held_out_error_mm": {"before": "low", "after": 1, "floor": 0}},
        {**Revision("2026-01-01", "x").to_dict(), "held_out_error_mm": {"before": -1.0, "after": 1, "floor": 0}},
        {**Revision("2026-01-01", "x").to_dict(), "parameters": {"density": [0.1]}},
    ],
)
def test_a_damaged_history_is_refused(entry, tmp_path):
    document = json.loads(snug_model().to_json()) | {"history": [entry]}
    path = tmp_path / "m.json"
    path.write_text(json.dumps(document))
    with pytest.raises(CaphyError, match=r"m\.json.*no revision"):
        Model.load(path)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("parameters", {"a": ["x", "y"]}, 'a must be two values, numbers or null each, got ["x", "y"]'),
        ("parameters", {"a": [{"b": 1}, {"c": 2}]}, "a must be two values"),
        ("parameters", {"a": [[1, [2, 3]], [1]]}, "a must be two values"),
        ("parameters", {"a": [True, 1.0]}, "a must be two values"),
        ("parameters", {"a": [float("nan"), 1.0]}, "a must be two values"),
        ("parameters", {"a": [10**400, 1.0]}, "a must be two values"),
        ("parameters", {"a": [1, 2, 3]}, "a must be two values"),
        ("added", "abc", 'added must be a list of texts, got "abc"'),
        ("data", [1], "data must be a text, got 1"),
        ("date", None, "date must be a text, got null"),
        ("note", 3, "note must be a text, got 3"),
        ("held_out_error_mm", {"before": 1, "after": 1, "floor": 10**400}, "error floor must be a finite number"),
        (
            "held_out_error_mm",
            {"before": True, "after": 1, "floor": 0},
            "the held-out error before must be a finite number, not negative, got true",
        ),
    ],
)
def test_what_a_history_written_by_hand_says_wrongly_is_told(tmp_path, capsys, key, value, says):
    first, second = (Revision("2026-01-01", "x").to_dict() for _ in range(2))
    path = tmp_path / "m.json"
    path.write_text(json.dumps(json.loads(snug_model().to_json()) | {"history": [first, second | {key: value}]}))
    assert main(["effects", "history", str(path)]) == 2
    told = capsys.readouterr().err
    assert f"{path}: its history's entry 2 is no revision" in told and says in told


def test_a_note_is_shown_in_one_line_and_moves_no_terminal(tmp_path, capsys):
    path = tmp_path / "model.json"
    path.write_text(snug_model().revised(snug_model(), "a\nb\x1b[31mred\ud800 \u00e9").to_json())
    assert main(["effects", "history", str(path)]) == 0
    assert r"a\nb\x1b[31mred\ud800 é" in capsys.readouterr().out


def test_the_command_shows_it(tmp_path, capsys):
    path = tmp_path / "model.json"
    path.write_text(refitted().to_json())
    assert main(["effects", "history", str(path)]) == 0
    said = capsys.readouterr().out
    assert "11.20 -> 4.80" in said and "2.10" in said and "+air_drag_normal" in said and "-attachment" in said
    assert "bending.stiffness_weft 3.96e-05 -> 1e-05" in said and "the waistband slips" in said
    path.write_text(snug_model().to_json())
    assert main(["effects", "history", str(path)]) == 0
    assert "no revisions" in capsys.readouterr().out
    assert main(["effects", "history", str(tmp_path / "none.json")]) == 2
    assert "none.json" in capsys.readouterr().err
