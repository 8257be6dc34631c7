"""``caphy validate`` holds a run against the solver, and export carries what it found."""

from __future__ import annotations

import json

from small_world import swaying, tube

from caphy.cli import main
from caphy.io.poses import write_poses
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
    assert list(report["clips"]) == ["swaying 1"]
    # The solver minimises what the network was barely trained to.
    assert report["potential_of_solver_J"] < report["potential_J"]
    assert report["distance_to_solver_mm"] > 0 and report["drift_frames"] == 120
    assert read_run(run).metrics["beside_solver"] == report

    unseen.unlink()
    assert main(["validate", str(run)]) == 2
    assert "give pose files" in capsys.readouterr().err
    assert main(["validate", str(tmp_path)]) == 2
    assert "not a folder that 'caphy train' wrote" in capsys.readouterr().err
