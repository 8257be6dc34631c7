"""Motion classes, splits by pose, and the figures of the table."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caphy.errors import CaphyError
from caphy.evaluate.classes import LIKE, UNLIKE, like_and_unlike, pose_distances, read_classes, unlike_split
from caphy.evaluate.evaluation import Evaluation
from caphy.evaluate.rows import AVATAR, NO_PHYSICS, OURS, TEMPLATE, Row, given_row, known_rows
from caphy.evaluate.table import table_lines


def _poses(count: int, seed: int = 0) -> np.ndarray:
    return 0.4 * np.random.default_rng(seed).standard_normal((count, 55, 3))


def test_pose_distance_is_the_mean_angle_of_the_body_s_joints():
    poses, others = _poses(3, 1), _poses(2, 2)
    found = pose_distances(poses, others)
    between = Rotation.from_rotvec(poses[2, 1:22]).inv() * Rotation.from_rotvec(others[1, 1:22])
    assert found.shape == (3, 2)
    assert found[2, 1] == pytest.approx(between.magnitude().mean())
    turned = poses.copy()
    turned[:, 0] = 2.0  # which way they face
    turned[:, 22:] = 1.0  # and their fingers
    assert pose_distances(poses, turned).diagonal() == pytest.approx(0, abs=1e-6)


def test_the_farther_half_is_unlike():
    assert like_and_unlike(["a", "b", "c"], np.array([0.3, 0.1, 0.2])) == {"a": UNLIKE, "b": LIKE, "c": LIKE}


def test_a_split_by_pose_holds_out_a_group_of_its_own():
    poses = 0.05 * _poses(10, 3)
    poses[[2, 7]] += 0.6 * np.random.default_rng(4).standard_normal((55, 3))
    split = unlike_split([f"s{i}" for i in range(10)], poses)
    assert sorted(split["held_out"]) == ["s2", "s7"] and len(split["train"]) == 8
    assert unlike_split(["one"], poses[:1]) == {"train": ["one"], "held_out": []}


def test_classes_given_must_name_every_scan(tmp_path):
    path = tmp_path / "classes.json"
    path.write_text(json.dumps({"a": "running", "b": "walking", "c": "none of it"}))
    assert read_classes(path, ["b", "a"]) == {"b": "walking", "a": "running"}
    with pytest.raises(CaphyError, match="no class for d"):
        read_classes(path, ["a", "d"])
    path.write_text(json.dumps({"a": "running", "b": None}))
    with pytest.raises(CaphyError, match="no class for b"):
        read_classes(path, ["a", "b"])
    path.write_text("[1]")
    with pytest.raises(CaphyError, match="must be a JSON object"):
        read_classes(path, ["a"])


@pytest.fixture
def evaluation():
    """Two scans, of two classes; a row with two seeds and one without networks."""
    rows = (Row(TEMPLATE), Row("ours"), Row("SNUG", missing="not trained"))
    found = Evaluation(rows, {"a": "walking", "b": "running"}, {"a": 5.0, "b": 15.0}, 8, None)
    found.scores[TEMPLATE] = {TEMPLATE: {"a": {"clothes_chamfer_mm": 10.0}, "b": {"clothes_chamfer_mm": 20.0}}}
    found.scores["ours"] = {
        "seed_1": {"a": {"clothes_chamfer_mm": 4.0}, "b": {"clothes_chamfer_mm": 6.0}},
        "seed_2": {"a": {"clothes_chamfer_mm": 6.0}, "b": {"clothes_chamfer_mm": 9.0}},
    }
    return found


def test_figures_are_means_over_scans_and_their_spread_is_that_of_seeds(evaluation):
    assert evaluation.figures("ours")["clothes_chamfer_mm"] == {"mean": 6.25, "spread": pytest.approx(2.5 / 2**0.5)}
    assert evaluation.figures("ours", "running")["clothes_chamfer_mm"]["mean"] == 7.5
    assert evaluation.figures(TEMPLATE)["clothes_chamfer_mm"] == {"mean": 15.0, "spread": 0.0}
    assert evaluation.figures("SNUG") == {}


def test_the_table_says_what_is_there_and_what_is_not(evaluation):
    lines = table_lines(evaluation.document())
    row = {line.split("  ")[0]: line.split() for line in lines}
    assert row["ours"][1:] == ["2", "6.25", "±", "1.77"] or row["ours"][1:] == [
        "7.50",
        "±",
        "2.12",
        "5.00",
        "±",
        "1.41",
    ]
    assert any(line.split() == ["ours", "2", "6.25", "±", "1.77"] for line in lines)
    assert any(line.split() == ["skinned", "template", "15.00"] for line in lines)
    assert any(line.split() == ["SNUG", "0", "–"] for line in lines)
    assert "  SNUG: not trained" in lines
    assert "running (1; 15 degrees)" in "\n".join(lines)
    json.dumps(evaluation.document(), allow_nan=False)


def test_scans_that_could_not_be_evaluated_are_not_counted(evaluation):
    evaluation.classes["c"], evaluation.distances["c"] = "running", 45.0
    evaluation.unused["c"] = "shows nothing"
    document = evaluation.document()
    assert sorted(document["scans"]) == ["a", "b"]
    text = "\n".join(table_lines(document))
    assert "scans held out: 2" in text and "running (1; 15 degrees)" in text and "  c: shows nothing" in text


def test_templates_that_know_what_is_held_out_are_told(evaluation):
    assert "caution" not in "\n".join(table_lines(evaluation.document()))
    evaluation.chosen_by["upper"] = ["a"]
    lines = table_lines(evaluation.document())
    assert any("1 of the scans held out have chosen the template of the upper garment" in line for line in lines)


def test_a_row_that_lacks_a_scan_says_how_many_its_means_are_of(evaluation):
    del evaluation.scores["ours"]["seed_2"]["b"]
    evaluation.failed["ours"] = {"seed_2: not finite": ["b"]}
    assert evaluation.figures("ours")["clothes_chamfer_mm"]["mean"] == 5.0  # of both seeds on the scan that both have
    lines = table_lines(evaluation.document())
    assert [line.split() for line in lines if line.startswith(("skinned", "ours "))][:2] == [
        ["skinned", "template", "2", "15.00"],
        ["ours", "2", "1", "5.00", "±", "1.41"],
    ]
    assert "  ours, in part: seed_2: not finite (b)" in lines


def _networks(folder):
    for kind in ("upper", "lower"):
        (folder / kind).mkdir(parents=True)
        (folder / kind / "network.safetensors").write_bytes(b"")


def test_rows_are_found_where_a_run_keeps_them(tmp_path):
    _networks(tmp_path / "train")
    _networks(tmp_path / "rows" / "snug" / "seed_1")
    _networks(tmp_path / "rows" / "snug" / "seed_2")
    rows = {row.name: row for row in known_rows(tmp_path)}
    assert [path.name for path in rows["SNUG"].folders] == ["seed_1", "seed_2"]
    assert rows[NO_PHYSICS].folders == (tmp_path / "train",)
    assert rows[OURS].missing is not None and "rows/data_only" in (rows["data-only"].missing or "")
    assert AVATAR not in rows


def test_rows_are_found_where_the_paper_s_are_trained_besides_the_avatar(tmp_path):
    """Two rows that papertable trains stand before what was trained last, which is still the avatar's."""
    for name in ("upper.npz", "lower.npz"):
        (tmp_path / name).write_bytes(b"")
    for name in ("train", "fabric", "collided", "rows/default_physics/seed_1", "rows/ours/seed_1"):
        _networks(tmp_path / name)
    rows = {row.name: row for row in known_rows(tmp_path)}
    assert rows[NO_PHYSICS].folders == (tmp_path / "rows" / "default_physics" / "seed_1",)
    assert rows[OURS].folders == (tmp_path / "rows" / "ours" / "seed_1",)
    assert rows[AVATAR].folders == (tmp_path / "collided",) and list(rows)[-1] == AVATAR
    (tmp_path / "collided" / "upper" / "network.safetensors").unlink()  # stopped halfway: no avatar is made of it
    assert {row.name: row for row in known_rows(tmp_path)}[AVATAR].folders == (tmp_path / "fabric",)


def test_what_was_fine_tuned_is_ours_only_if_the_fabric_was_optimised(tmp_path):
    _networks(tmp_path / "train")
    _networks(tmp_path / "collided")
    rows = {row.name: row for row in known_rows(tmp_path)}
    assert rows[NO_PHYSICS].folders == (tmp_path / "collided",) and not rows[OURS].folders
    tables = {"bending": {"over_the_start": "not determined", "interval": None}}
    (tmp_path / "fabric.json").write_text(json.dumps({"garments": {"upper": {"stiffness": tables}}}))
    assert not {row.name: row for row in known_rows(tmp_path)}[OURS].folders
    tables["bending"] = {"over_the_start": 2.0, "interval": [1.5, 2.6]}
    (tmp_path / "fabric.json").write_text(json.dumps({"garments": {"upper": {"stiffness": tables}}}))
    rows = {row.name: row for row in known_rows(tmp_path)}
    assert rows[NO_PHYSICS].folders == (tmp_path / "train",) and rows[OURS].folders == (tmp_path / "collided",)


def test_a_row_given_must_hold_networks(tmp_path):
    _networks(tmp_path / "mine")
    assert given_row(f"mine={tmp_path / 'mine'}").folders == (tmp_path / "mine",)
    with pytest.raises(CaphyError, match="NAME=FOLDER"):
        given_row("mine")
    with pytest.raises(CaphyError, match="holds no networks"):
        given_row(f"mine={tmp_path}")
    with pytest.raises(CaphyError, match="is that of clothes without a network"):
        given_row(f"skinned template={tmp_path / 'mine'}")
