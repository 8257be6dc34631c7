"""``caphy export`` from training folders to a bundle that serves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from shell_avatar import random_network, shell, wiggle

from caphy.cli import main
from caphy.io.bundle import read_bundle
from caphy.io.poses import write_poses
from caphy.network.files import save_network
from service.engine import GarmentEngine


def run_folder(folder: Path, name: str, **changes) -> Path:
    garment, network = shell(name), random_network(shell(name), width=16)
    for key, value in changes.items():
        setattr(network, key, value)
    garment.save(folder / name / "garment.npz")
    save_network(network, folder / name / "network.safetensors")
    (folder / name / "run.json").write_text(
        json.dumps({"seed": 7, "betas": [], "body": "/home/me/body.npz", "held_out_paths": [str(folder / "held.npz")]})
    )
    (folder / name / "model.json").write_text(json.dumps({"effects": ["gravity"]}))
    lines = [{"step": 1, "validation": {"deep": 2}}, {"step": 2, "loss_J": 1}, {"step": 2, "validation": {"deep": 1}}]
    (folder / name / "metrics.jsonl").write_text("\n".join(json.dumps(line) for line in lines))
    return folder / name


def test_two_runs_become_one_avatar(tmp_path, capsys):
    runs = [str(run_folder(tmp_path, name)) for name in ("trousers", "tshirt")]
    write_poses(wiggle(1.0), tmp_path / "walk.npz")
    out = tmp_path / "avatars" / "mine"
    assert main(["export", *runs, "-o", str(out), "--motions", str(tmp_path / "walk.npz")]) == 0, capsys.readouterr()
    said = capsys.readouterr().out
    assert "avatar of 2 garments, " in said and "caphy demo --avatar" in said
    bundle = read_bundle(out)
    assert (bundle.name, [g.name for g in bundle.garments]) == ("mine", ["trousers", "tshirt"])
    metrics = bundle.metrics["tshirt"]
    assert metrics["held_out"] == {"deep": 1}
    assert metrics["parity_with_torch_mm"] < 0.01
    assert metrics["head_worst_vertex_error_mm"] < 0.05
    made = bundle.provenance["garments"]["tshirt"]
    assert made["training"] == {"seed": 7, "betas": []}  # no paths of the machine it was trained on
    assert made["model"] == {"effects": ["gravity"]}
    network, motion = random_network(shell("tshirt"), width=16), wiggle(0.5, seed=9)
    engine = GarmentEngine(bundle.garment("tshirt"))
    arrays = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    np.testing.assert_allclose(engine.run(*arrays, engine.initial_state())[0], network.stream(*arrays), atol=2e-5)


def test_what_stands_in_the_way_is_told_before_anything_is_computed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("export.again.exported_again", lambda bundle: pytest.fail("computed in vain"))
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["export", "default", "-o", str(tmp_path / "notes.txt")]) == 2
    assert "exists and is no avatar bundle" in capsys.readouterr().err
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("name", ["shirt.glb", "shirt.usdc"])
def test_a_folder_of_the_files_name_is_told_and_nothing_is_left(tmp_path, name, capsys):
    if name.endswith("usdc"):
        pytest.importorskip("pxr")
    write_poses(wiggle(0.2), tmp_path / "walk.npz")
    (tmp_path / name).mkdir()
    arguments = ["--format", name[-4:-1] if "usd" in name else "glb", "--poses", str(tmp_path / "walk.npz")]
    assert main(["export", "default", "-o", str(tmp_path / name), *arguments]) == 2
    assert name in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == [name, "walk.npz"]


def test_the_avatar_that_comes_along_has_a_name(tmp_path, monkeypatch):
    monkeypatch.setattr("export.again.exported_again", lambda bundle: (bundle, {}))
    assert main(["export", "default", "-o", str(tmp_path / "copy")]) == 0
    assert [g.name for g in read_bundle(tmp_path / "copy").garments] == ["trousers", "tshirt"]


def test_the_heads_error_is_stated_on_motions_held_out_of_training(tmp_path, capsys):
    write_poses(wiggle(1.0), tmp_path / "held.npz")
    run = run_folder(tmp_path, "tshirt")
    assert main(["export", str(run), "-o", str(tmp_path / "out")]) == 0
    assert "avatar of 1 garment, " in capsys.readouterr().out
    bundle = read_bundle(tmp_path / "out")
    assert bundle.provenance["head_error_measured_on"] == ["held.npz#15-30"]


def test_nothing_is_written_where_the_graph_differs(tmp_path, capsys, monkeypatch):
    write_poses(wiggle(1.0), tmp_path / "held.npz")
    run = run_folder(tmp_path, "tshirt")
    monkeypatch.setattr("export.features_graph.LIMIT", 0.1)
    assert main(["export", str(run), "-o", str(tmp_path / "out")]) == 2
    assert "must answer as the network does" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_the_user_can_put_right(tmp_path, capsys):
    out = ["-o", str(tmp_path / "out")]
    assert main(["export", str(tmp_path / "none"), *out]) == 2
    assert "caphy train" in capsys.readouterr().err
    moved = run_folder(tmp_path / "a", "tshirt", joints=torch.zeros(55, 3))
    assert main(["export", str(moved), *out]) == 2
    assert "trained on another body" in capsys.readouterr().err
    slow = run_folder(tmp_path / "b", "tshirt", fps=25.0)
    assert main(["export", str(run_folder(tmp_path, "trousers")), str(slow), *out]) == 2
    assert "one rate" in capsys.readouterr().err
    assert main(["export", str(slow), *out, "--body", "mine.npz"]) == 2
    assert "--licence" in capsys.readouterr().err
    other = run_folder(tmp_path / "c", "tshirt")
    shell("trousers").save(other / "garment.npz")
    assert main(["export", str(other), *out]) == 2
    assert "is not the garment" in capsys.readouterr().err


def test_a_training_that_came_to_nothing_is_refused(tmp_path, capsys):
    """Its garment had faces without area, so that strain is not a number anywhere."""
    run = run_folder(tmp_path, "tshirt")
    line = {"validation": {"potential_J": 0.1, "energies_J": {"gravity": -0.1, "strain_stvk": float("nan")}}}
    (run / "metrics.jsonl").write_text(json.dumps(line))
    assert main(["export", str(run), "-o", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert "metrics.jsonl" in told and "strain_stvk is not" in told and "train again" in told
    assert not (tmp_path / "out").exists()
