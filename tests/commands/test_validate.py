"""``caphy validate`` holds a run against the solver, and export carries what it found."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace

import numpy as np
from small_world import swaying, tube

from caphy.cli import main
from caphy.commands.begun import exporting
from caphy.commands.validate import Validate, _clips, _names
from caphy.io.poses import write_poses
from caphy.io.procedural import procedural_motion
from export.runs import read_run


def test_measures_a_run_beside_the_solver(tmp_path, capsys):
    tube().save(tmp_path / "tube.npz")
    for seed in range(2):
        write_poses(swaying(20, seed), tmp_path / f"{seed}.npz")
    run, unseen = tmp_path / "run", tmp_path / "1.npz"
    inputs = [str(tmp_path / "tube.npz"), str(tmp_path / "0.npz"), "--held-out", str(unseen), "--steps", "2"]
    assert main(["train", *inputs, "-o", str(run)]) == 0
    assert main(["validate", str(run), "--seconds", "0.2", "--frames", "120"]) == 0
    assert f"wrote {run / 'validation.json'}" in capsys.readouterr().out
    report = json.loads((run / "validation.json").read_text())
    assert list(report["clips"]) == ["1.npz"]
    # The solver minimises what the network was barely trained to.
    assert report["potential_of_solver_J"] < report["potential_J"]
    assert report["distance_to_solver_mm"] > 0 and report["drift_frames"] == 120
    assert read_run(run).metrics["beside_solver"] == {k: v for k, v in report.items() if k != "network_sha256"}
    (run / "validation.json").write_text(json.dumps({**report, "network_sha256": "of another"}))
    told = []
    assert "beside_solver" not in read_run(run, told.append).metrics
    assert "is of another network" in told[0]
    (run / "validation.json").write_text(json.dumps({**report, "drift_mm": float("nan")}))
    assert "beside_solver" not in read_run(run, told.append).metrics
    assert "validation.json is left out, drift_mm in it is not finite" in told[1]

    assert main(["validate", str(run), "--frames", "0"]) == 2
    assert "--frames must be at least 1, got 0" in capsys.readouterr().err
    unseen.unlink()
    assert main(["validate", str(run)]) == 2
    assert "give pose files" in capsys.readouterr().err
    assert main(["validate", str(tmp_path)]) == 2
    assert "not a folder that 'caphy train' wrote" in capsys.readouterr().err


def test_motions_of_one_name_are_told_apart(tmp_path):
    walk, run = replace(swaying(20, 0), source="a/walk.npz"), replace(swaying(20, 0), source="b/run.npz")
    assert _names([walk, run]) == ["walk.npz", "run.npz"]
    other = replace(walk, source="b/walk.npz")
    assert _names([walk, other, walk]) == ["a/walk.npz (1)", "b/walk.npz", "a/walk.npz (2)"]
    walk, other = (replace(walk, source=f"/home/somebody/{folder}/walk.npz") for folder in "ab")
    assert _names([walk, other]) == ["a/walk.npz", "b/walk.npz"]  # avatars carry them on


def test_held_out_motions_are_found_from_any_folder(tmp_path, monkeypatch, capsys):
    tube().save(tmp_path / "tube.npz")
    for seed in range(2):
        write_poses(swaying(20, seed), tmp_path / f"{seed}.npz")
    monkeypatch.chdir(tmp_path)
    assert main(["train", "tube.npz", "0.npz", "--held-out", "1.npz", "--steps", "1", "-o", "run"]) == 0
    assert "next: caphy export run -o avatars/run" in capsys.readouterr().out
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert read_run(tmp_path / "run").held_out == (str(tmp_path / "1.npz"),)


def test_an_export_on_a_body_of_one_s_own_names_it(tmp_path):
    run = tmp_path / "mine"
    run.mkdir()
    (run / "options.json").write_text(json.dumps({"body": str(tmp_path / "my body.npz")}))
    assert shlex.split(exporting("worn", run, run)) == [
        *("caphy", "export", str(run), str(run), "--body", str(tmp_path / "my body.npz")),
        *("--licence", "the licence of this body", "-o", "avatars/worn"),
    ]


def test_of_a_clip_whose_end_is_held_out_the_end_is_measured(tmp_path):
    """... and not its beginning, which was trained on."""
    tube().save(tmp_path / "tube.npz")
    write_poses(swaying(40), tmp_path / "one.npz")
    run = tmp_path / "run"
    words = ["train", str(tmp_path / "tube.npz"), str(tmp_path / "one.npz"), "--steps", "1", "-o", str(run)]
    assert main(words) == 0
    assert main(["validate", str(run), "--seconds", "0.2", "--frames", "60"]) == 0
    assert list(json.loads((run / "validation.json").read_text())["clips"]) == ["one.npz#32-40"]
    assert read_run(run).held_out == (f"{tmp_path / 'one.npz'}#32-40",)
    (clip,) = _clips(Validate(run), json.loads((run / "run.json").read_text()), 30.0)
    np.testing.assert_array_equal(clip.poses, swaying(40).poses[32:])
    write_poses(swaying(39), tmp_path / "one.npz")
    assert main(["validate", str(run)]) == 2
    write_poses(swaying(1), tmp_path / "short.npz")
    assert main(["validate", str(run), str(tmp_path / "short.npz")]) == 2


def test_motions_made_from_seeds_are_made_again_and_those_that_are_gone_named(tmp_path, capsys):
    names = [procedural_motion(5, 20.0, 30.0).source, str(tmp_path / "gone.npz")]
    (made,) = _clips(Validate(tmp_path), {"held_out_paths": names}, 30.0)
    np.testing.assert_array_equal(made.poses, procedural_motion(5, 20.0, 30.0).poses)
    assert "gone.npz was held out of training, and is not there any more" in capsys.readouterr().out
