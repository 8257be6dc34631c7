"""What is held against held-out scans: no network that may know them, and none that another one's failure costs."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from small_run import SPLIT, garments, small_run, write_networks

from caphy.errors import CaphyError
from caphy.evaluate.dressed import Subject
from caphy.evaluate.evaluation import evaluate
from caphy.evaluate.learnt_from import INIT_SCANS, SCANS_DIGEST, learnt_from, require_same_scans
from caphy.evaluate.rows import TEMPLATE, Row, given_row
from caphy.io.bundle import MANIFEST
from caphy.io.training_folder import OPTIONS
from caphy.scan.mesh_files import MeshFile, write_ply
from caphy.scan.scan import BODY, LOWER
from caphy.scan.scan_set import ScanSet


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A run and its scans."""
    return small_run(tmp_path_factory.mktemp("held_out"))


def test_what_learnt_from_other_scans_is_left_out(world, tmp_path):
    """As after an edit of split.json, whose held-out scans it then knows; what learnt from none knows none of them."""
    run, scans = world
    write_networks(tmp_path / "same", run)
    write_networks(tmp_path / "other", run, learnt_from="of another split")
    write_networks(tmp_path / "physics", run, learnt_from=None)
    write_networks(tmp_path / "went on", run, init="../../other/upper")
    rows = [given_row(f"{name}={tmp_path / name}") for name in ("same", "other", "physics", "went on")]
    found = evaluate(run, scans, rows, None)
    assert set(found.scores) == {"same", "physics"}
    assert all("trained on other scans" in found.left_out[name] for name in ("other", "went on"))
    assert found.document()["rows"][1]["missing"] == found.left_out["other"]


def test_an_edited_split_leaves_out_what_was_trained_before(tmp_path):
    run, scans = small_run(tmp_path)
    row = given_row(f"mine={write_networks(tmp_path / 'mine', run)}")
    assert "mine" in evaluate(run, scans, [row], None).scores
    split = json.loads((run / "split.json").read_text())
    (run / "split.json").write_text(json.dumps({"train": split["held_out"], "held_out": split["train"]}))
    with pytest.raises(CaphyError, match=r"nothing could be evaluated:\n.*mine: trained on other scans"):
        evaluate(run, scans, [row], None)


def test_a_template_chosen_by_what_is_held_out_now_is_told(tmp_path):
    """As where the split was drawn anew since."""
    run, scans = small_run(tmp_path)
    split = json.loads((run / "split.json").read_text())
    told = {"upper": {"scans": split["train"]}, "lower": {"scans": [*split["train"], split["held_out"][0]]}}
    (run / "garments.json").write_text(json.dumps(told))
    found = evaluate(run, scans, [Row(TEMPLATE)], None).document()
    assert found["templates_chosen_by_held_out"] == {"lower": split["held_out"][:1]}


def test_a_row_that_comes_to_nothing_costs_the_others_nothing(world, tmp_path):
    run, scans = world
    rows = [
        given_row(f"good={write_networks(tmp_path / 'good', run)}"),
        given_row(f"bad={write_networks(tmp_path / 'bad', run, bias=3e38)}"),
    ]
    found = evaluate(run, scans, [Row(TEMPLATE), *rows], None)
    assert set(found.scores) == {TEMPLATE, "good"}
    (scored,) = found.scores["good"].values()
    assert list(scored) == SPLIT["held_out"] and all(figures["clothes_chamfer_mm"] < 1 for figures in scored.values())
    assert "vertices that are not finite; train it again (scan2, scan3)" in found.left_out["bad"]
    assert found.document()["rows"][2]["missing"] == found.left_out["bad"]


def test_a_scan_that_shows_one_garment_counts_for_that_one(tmp_path):
    run, scans = small_run(tmp_path)
    scan = scans[3]
    write_ply(
        scans.files[3], MeshFile(scan.vertices, scan.faces, None, np.where(scan.labels == LOWER, BODY, scan.labels))
    )
    found = evaluate(run, ScanSet.read(scans.folder), [Row(TEMPLATE)], None)
    two, one = found.scores[TEMPLATE][TEMPLATE].values()
    assert "lower_chamfer_mm" in two and "lower_chamfer_mm" not in one
    assert one["clothes_chamfer_mm"] == pytest.approx(one["upper_chamfer_mm"]) and one["clothes_chamfer_mm"] < 1
    figures = found.figures(TEMPLATE)
    assert figures["lower_chamfer_mm"]["mean"] == two["lower_chamfer_mm"]
    assert figures["upper_chamfer_mm"]["mean"] == pytest.approx((two["upper_chamfer_mm"] + one["upper_chamfer_mm"]) / 2)
    assert "shows no lower garment" in found.document()["left_out"]["scan3, lower"]


def test_what_it_went_on_from_is_told_by_its_record_too(world, tmp_path):
    """Whatever became of the folder that it went on from."""
    run, _ = world
    write_networks(tmp_path / "went on", run, learnt_from=None, init="../../lost/upper")
    folder = tmp_path / "went on" / "upper"
    assert not list(learnt_from(folder))
    (folder / "run.json").write_text(json.dumps({INIT_SCANS: ["b"]}))
    assert list(learnt_from(folder)) == ["b"]


def test_what_a_network_began_as_is_told_like_what_it_went_on_from(world, tmp_path):
    """By --transfer it takes the weights over too."""
    run, _ = world
    write_networks(tmp_path / "first", run, learnt_from="c")
    write_networks(tmp_path / "begun", run, learnt_from=None)
    folder = tmp_path / "begun" / "upper"
    told = json.loads((folder / OPTIONS).read_text())
    (folder / OPTIONS).write_text(json.dumps(told | {"transfer": "../../first/upper"}))
    assert list(learnt_from(folder)) == ["c"]


@pytest.mark.parametrize(
    ("training", "refused"),
    [
        ({"scans": None}, ""),
        ({"scans": "run", SCANS_DIGEST: "a"}, ""),
        ({"scans": "run", SCANS_DIGEST: "b"}, "trained on other scans than"),
        ({"scans": "run"}, "for all that is kept beside it"),
        ({"scans": None, INIT_SCANS: ["a"]}, ""),
        ({"scans": None, INIT_SCANS: ["b"]}, "trained on other scans than"),
    ],
)
def test_an_avatar_tells_what_its_garments_learnt_from(tmp_path, training, refused):
    (tmp_path / MANIFEST).write_text(json.dumps({"provenance": {"garments": {"shirt": {"training": training}}}}))
    with pytest.raises(CaphyError, match=refused) if refused else nullcontext():
        require_same_scans(tmp_path, ("upper",), "a")


def test_what_was_trained_on_a_template_of_another_shape_is_refused(world, tmp_path):
    run, _ = world
    folder = write_networks(tmp_path / "mine", run)
    subject = Subject.read(run)
    assert set(subject.wearing(folder).networks) == {"upper", "lower"}
    longer = replace(garments()["lower"], vertices=garments()["lower"].vertices * np.array([1, 1.01, 1]))
    other = replace(subject, garments={**subject.garments, "lower": longer})
    with pytest.raises(CaphyError, match=r"its lower garment was trained on another template.*another shape"):
        other.wearing(folder)
