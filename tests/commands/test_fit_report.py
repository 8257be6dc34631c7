"""What the page of ``caphy fit`` says of an avatar that is worse than its template."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import pytest

from benchmarks import papertable
from caphy.commands.fit_report import _first, _no_gain
from caphy.commands.fit_stages import Plan, stages
from caphy.errors import CaphyError
from caphy.pipeline.runner import run_stages


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


def test_a_failure_is_told_with_what_it_announces():
    assert _first("nothing could be evaluated:\n  FLIP needs its authors' package\nmore") == (
        "nothing could be evaluated: FLIP needs its authors' package"
    )
    assert _first("no network: at all") == "no network: at all" and _first("left alone:") == "left alone:"


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


def test_a_fabric_made_by_hand_after_its_fit_failed_is_kept(tmp_path, monkeypatch):
    """As 'caphy fabric RUN' with other options leaves it; half of one is no fabric."""

    def fail(words: list[str]) -> int:
        raise CaphyError("no garment's fabric could be fitted")

    monkeypatch.setattr("caphy.commands.fabric.main", fail)
    one = [stage for stage in stages(_plan(tmp_path), 4) if stage.name == "fabric"]
    assert list(run_stages(one, tmp_path).failed) == ["fabric"]
    (tmp_path / "fabric.json").write_text('{"garments": {"upper": {"model_file": "fabric_upper.json"}}}')
    assert list(run_stages(one, tmp_path).failed) == ["fabric"] and not (tmp_path / "fabric.json").exists()
    (tmp_path / "fabric.json").write_text('{"garments": {"upper": {"model_file": "fabric_upper.json"}}}')
    for other in ("[]", '{"garments": {}}', '{"garments": {"upper": {}}}', '{"density_kg_per_m2": 0.2, "effects": {}}'):
        (tmp_path / "fabric.json").write_text(other)
        assert list(run_stages(one, tmp_path).failed) == ["fabric"]
    (tmp_path / "fabric.json").write_text('{"garments": {"upper": {"model_file": "fabric_upper.json"}}}')
    (tmp_path / "fabric_upper.json").write_text("by hand")
    assert run_stages(one, tmp_path).done == ["fabric"] and run_stages(one, tmp_path).kept == ["fabric"]
    assert (tmp_path / "fabric_upper.json").read_text() == "by hand"


def _keys(plan: Plan) -> dict[str, str]:
    return {stage.name: stage.key() for stage in stages(plan, 4)}


def test_what_files_are_called_and_where_they_lie_does_not_matter(tmp_path):
    """Hours of training are not done again for a folder that was renamed."""
    (tmp_path / "given").mkdir()
    (tmp_path / "given" / "a.ply").write_bytes(b"1")
    for name in ("motions", "run"):
        (tmp_path / name).mkdir()
    (tmp_path / "motions" / "walk.npz").write_bytes(b"2")
    (tmp_path / "mine.npz").write_bytes(b"3")
    (tmp_path / "mine.onnx").write_bytes(b"4")
    plan = replace(_plan(tmp_path / "run"), scans=tmp_path / "given", poses=(tmp_path / "motions",))
    plan = replace(plan, body=str(tmp_path / "mine.npz"), parser=str(tmp_path / "mine.onnx"))
    before = _keys(plan)
    (tmp_path / "elsewhere").mkdir()
    for name in ("given", "motions", "mine.npz", "mine.onnx"):
        (tmp_path / name).rename(tmp_path / "elsewhere" / f"other.{name}")
    there = tmp_path / "elsewhere"
    moved = replace(plan, scans=there / "other.given", poses=(there / "other.motions",))
    moved = replace(moved, body=str(there / "other.mine.npz"), parser=str(there / "other.mine.onnx"))
    assert _keys(moved) == before
    (there / "other.mine.npz").write_bytes(b"another body")
    after = _keys(moved)
    assert {name for name in after if after[name] != before[name]} == {"body", "points", "garments"}
    assert _keys(replace(plan, body="fine"))["body"] != _keys(replace(plan, body="medium"))["body"]


def test_a_network_validated_by_hand_is_no_other_network(tmp_path):
    """The avatar tells what was measured, so it alone is written again."""
    trained = tmp_path / "train" / "upper"
    trained.mkdir(parents=True)
    before = _keys(_plan(tmp_path))
    for name in ("validation.json", "checkpoint.safetensors", "metrics.jsonl"):
        (trained / name).write_text("{}")
    after = _keys(_plan(tmp_path))
    assert [name for name in after if after[name] != before[name]] == ["export"]
    (trained / "network.safetensors").write_text("{}")
    again = _keys(_plan(tmp_path))
    assert {"fabric", "refine", "collide", "export", "evaluate"} == {n for n in again if again[n] != after[n]}


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
