"""What the page of ``caphy fit`` says of an avatar that is worse than its template."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import pytest

from benchmarks import papertable
from caphy.commands.fit_report import _no_gain
from caphy.commands.fit_stages import Plan, stages


def _row(name: str, clothes: float, upper: float, lower: float, look: float) -> dict:
    names = ("clothes_chamfer_mm", "upper_chamfer_mm", "lower_chamfer_mm", "perceptual")
    means = {key: {"mean": value} for key, value in zip(names, (clothes, upper, lower, look), strict=True)}
    return {"name": name, "all": means}


def test_a_garment_that_got_worse_is_told_though_all_together_got_better():
    template, avatar = _row("skinned template", 23.24, 9.0, 29.88, 0.341), _row("avatar", 18.82, 18.42, 20.22, 0.382)
    ours = _row("ours", 8.0, 8.0, 8.0, 0.1)  # as papertable trained it: the avatar wears other networks
    (said,) = _no_gain({"rows": [template, ours, avatar]})
    assert "the upper garment lies 18.42 mm from the scans' (template 9.00)" in said and "lower" not in said
    assert "pictures differ by 0.382 (template 0.341)" in said


def test_nothing_is_told_of_what_got_better():
    template, avatar = _row("skinned template", 23.24, 9.0, 29.88, 0.341), _row("avatar", 18.82, 8.42, 20.22, 0.3)
    assert _no_gain({"rows": [template, avatar]}) == [] == _no_gain({"rows": [template]}) == _no_gain({})


def _plan(folder: Path) -> Plan:
    given = dict.fromkeys(field.name for field in fields(Plan))
    given |= {"scans": folder / "given", "run": folder, "poses": (), "minutes": 1.0, "fabric_rounds": 1}
    return Plan(**given | {"fabric_scans": 3, "collision_epochs": 1})


def test_scans_are_checked_anew_when_what_lies_beyond_their_folder_has_changed(tmp_path):
    (tmp_path / "labels").mkdir()
    check = stages(_plan(tmp_path), 4, (tmp_path / "labels",))[0]
    before = check.key()
    (tmp_path / "labels" / "a.npy").write_bytes(b"1")
    assert check.key() != before


def test_models_of_an_earlier_fabric_do_not_outlive_it(tmp_path, monkeypatch):
    """Not where this one finds nothing of a garment; and one that is gone is fitted again."""

    def upper_alone(words: list[str]) -> int:
        (tmp_path / "fabric_upper.json").write_text("now")
        (tmp_path / "fabric.json").write_text('{"garments": {"upper": {"model_file": "fabric_upper.json"}}}')
        return 1

    for kind in ("upper", "lower"):
        (tmp_path / f"fabric_{kind}.json").write_text("before")
    monkeypatch.setattr("caphy.commands.fabric.main", upper_alone)
    (fabric,) = (stage for stage in stages(_plan(tmp_path), 4) if stage.name == "fabric")
    fabric.run()
    assert [path.name for path in tmp_path.glob("fabric_*.json")] == ["fabric_upper.json"] and fabric.whole()
    (tmp_path / "fabric_upper.json").unlink()
    assert not fabric.whole()


@pytest.mark.parametrize(("interval", "trained"), [([1.5, 2.6], True), (None, False)])
def test_papertable_trains_ours_only_under_a_fabric_that_was_found(tmp_path, monkeypatch, interval, trained):
    """'caphy fabric' writes models of garments of which it determined nothing as well."""
    (tmp_path / "upper.npz").write_bytes(b"")
    (tmp_path / "fabric_upper.json").write_text("{}")
    found = {"upper": {"stiffness": {"bending_measured": {"interval": interval}}}}
    (tmp_path / "fabric.json").write_text(json.dumps({"garments": found}))
    told = []
    monkeypatch.setattr(papertable, "_caphy", lambda *words: told.append(words) or 0)
    monkeypatch.setattr("sys.argv", ["papertable", str(tmp_path), "--rows", "ours"])
    papertable.main()
    assert [words[0] for words in told] == (["train"] if trained else []) + ["evaluate"]
    assert ("--model" in told[0]) == trained


def test_the_page_is_made_anew_when_what_it_tells_of_has_changed(tmp_path):
    *before, report = stages(_plan(tmp_path), 4)
    keys = [report.key()]
    for name in ("check.json", "body.json", *(f"stages/{stage.name}.json" for stage in before)):
        path: Path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("{}")
        keys.append(report.key())
    assert len(set(keys)) == len(keys)
