"""Supervised training from the command to its folder: training scans alone, resumed, gone on with."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from small_scans import posed, scan, supervised_trainer, worn, write_run
from small_world import swaying, tube

from caphy.cli import main
from caphy.commands.onward import onward
from caphy.commands.train import reopen
from caphy.effects.model import Model
from caphy.effects.presets import snug_model
from caphy.errors import CaphyError
from caphy.io.poses import write_poses
from caphy.io.training_folder import METRICS, NETWORK
from caphy.kept import digest
from caphy.network.files import load_network
from caphy.register.points import read_points
from caphy.training.validate import static_drape

STEPS = 40


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with points, a motion, and a supervised training beside one by physics alone."""
    folder = tmp_path_factory.mktemp("world")
    write_run(folder / "run", train=4, held_out=1)
    write_poses(swaying(60, 0), folder / "motion.npz")
    assert train(folder, "with", "--steps", str(STEPS)) == 0
    assert train(folder, "alone", "--steps", str(STEPS), "--lambda-3d", "1e-9") == 0
    return folder


def train(folder: Path, name: str, *more: str) -> int:
    poses, out = str(folder / "motion.npz"), str(folder / name)
    return main(["train", str(folder / "run" / "lower.npz"), poses, "--scans", str(folder / "run"), "-o", out, *more])


def from_truth(folder: Path, index: int) -> float:
    """Mean distance [m] of a network's cloth from the tube as it is really worn in a scan."""
    seen = scan(index)
    place = torch.tensor(seen.pose, dtype=torch.float32), torch.tensor(seen.transl, dtype=torch.float32)
    x = static_drape(load_network(folder / NETWORK), *place).numpy()
    return float(KDTree(posed(worn(tube()), tube().weights, seen.pose, seen.transl)).query(x)[0].mean())


def test_the_cloth_goes_where_the_scans_have_it_also_in_a_pose_not_trained_on(world):
    for index in (0, 4):
        assert from_truth(world / "with", index) < 0.75 * from_truth(world / "alone", index)


def test_held_out_scans_are_not_read(world):
    assert train(world, "few", "--steps", "4") == 0
    other = world / "other"
    shutil.copytree(world / "run", other / "run")
    (other / "run" / "points" / "scan4.npz").unlink()
    shutil.copy(world / "motion.npz", other)
    assert train(other, "again", "--steps", "4") == 0
    one, two = (load_network(folder / NETWORK).state_dict() for folder in (world / "few", other / "again"))
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_a_scan_that_lacks_the_garment_is_left_out_and_named(tmp_path, capsys):
    write_run(tmp_path / "run", train=3)
    replace(scan(1), lower=scan(1).lower[:10]).save(tmp_path / "run" / "points")
    write_poses(swaying(40, 0), tmp_path / "motion.npz")
    assert train(tmp_path, "some", "--steps", "1") == 0
    told = capsys.readouterr().out
    assert told.count("left out: scan1: has 10 points of the lower garment") == 1
    assert "2 scans and their mirror images," in told


def test_a_training_does_not_go_on_beneath_another_template(tmp_path, capsys):
    """Which garment hides which, and whether there are mirror images, was told by the one that was there."""
    write_run(tmp_path / "run", train=2)
    write_poses(swaying(40, 0), tmp_path / "motion.npz")
    assert train(tmp_path, "some", "--steps", "1") == 0
    tube().save(tmp_path / "run" / "upper.npz")
    assert train(tmp_path, "some", "--steps", "2", "--resume") == 2
    assert "was begun with other templates of the run, which have changed since" in capsys.readouterr().err


def test_what_it_was_trained_on_is_recorded_without_paths_in_the_record(world):
    record = json.loads((world / "with" / "run.json").read_text())
    assert record["scans_digest"] == digest(read_points(world / "run", "train"))  # 'caphy evaluate' asks for it
    assert record["scans"] == "run" and record["physics"] is True and record["lambda_3d"] is None
    assert str(world) not in json.dumps(
        {key: value for key, value in record.items() if key not in ("body", "held_out_paths")}
    )
    last = json.loads((world / "with" / METRICS).read_text().splitlines()[-1])
    assert last["step"] == STEPS and "held_out_scans" not in last["validation"]


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, {here!r})
from small_scans import supervised_trainer
trainer = supervised_trainer(Path(sys.argv[1]), steps=12)
save = trainer.save
def save_and_die():
    save()
    if trainer.progress.step == 5:
        os.kill(os.getpid(), signal.SIGKILL)
trainer.save = save_and_die
trainer.run(checkpoint_seconds=0)
"""


def test_killed_and_resumed_equals_uninterrupted(tmp_path):
    """The kill falls among the steps on scans."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    code = KILLED.format(here=str(Path(__file__).parent))
    assert subprocess.run([sys.executable, "-c", code, str(broken)], check=False).returncode == -signal.SIGKILL
    supervised_trainer(whole, steps=12).run()
    second = supervised_trainer(broken, steps=12)
    second.resume()
    assert second.progress.step == 5 and second.scan_track is not None and second.scan_track.streams.place.any()
    second.run()
    one, two = (load_network(folder / NETWORK).state_dict() for folder in (whole, broken))
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_scans_and_their_absence_are_not_mixed_up(tmp_path):
    trainer = supervised_trainer(tmp_path)
    trainer.step()
    trainer.save()
    trainer.scans = trainer.scan_track = None
    with pytest.raises(CaphyError, match="was trained with scans"):
        trainer.resume()


def test_goes_on_under_another_physics(world):
    heavy = snug_model().with_effect("heavy_hem", line_density=(0.3, 0, 0, 0))
    shutil.copytree(world / "alone", world / "base")
    before = reopen(world / "base")
    assert torch.equal(before.network.head.weight, load_network(world / "alone" / NETWORK).head.weight)

    def lowest(folder: Path) -> float:
        pose = torch.zeros(55, 3)
        return float(static_drape(load_network(folder / NETWORK), pose, torch.zeros(3))[:, 1].min())

    after = onward(before, heavy, 20, world / "heavy")
    for _ in range(6):
        after.step(after.progress.step / 20)
    after.save()  # and is killed here; the same call from the same start goes on
    again = onward(reopen(world / "base"), heavy, 20, world / "heavy")
    assert again.progress.step == 6
    again.run()
    assert Model.load(world / "heavy" / "model.json") == heavy
    assert lowest(world / "heavy") < lowest(world / "alone") - 0.002
    whole = onward(reopen(world / "base"), heavy, 20, world / "whole")
    whole.run()
    one, two = (load_network(world / name / NETWORK).state_dict() for name in ("heavy", "whole"))
    assert all(torch.equal(one[name], two[name]) for name in one)
    onward(again, snug_model(), 3, world / "heavy").run()  # other physics in the same folder: from the start of its own
    assert json.loads((world / "heavy" / METRICS).read_text().splitlines()[-1])["step"] == 3
    assert reopen(world / "heavy").objective.potential.model == snug_model()


def test_going_on_in_a_folder_of_another_depth_finds_its_files(world):
    """Also what was trained in the run's own folder, where paths are told from there."""
    inside = world / "run" / "train" / "lower"
    if not inside.exists():
        assert train(world, "run/train/lower", "--steps", "2") == 0
    folder = world / "run" / "fabric" / "1" / "lower"
    onward(reopen(inside), snug_model(), 2, folder).run()
    assert reopen(folder).scans is not None


def test_what_went_on_from_another_network_is_not_gone_on_with(world):
    """Of the same name and as many steps: the one before has been trained further since."""
    first, further = world / "first" / "lower", world / "further" / "lower"
    for folder, name in ((first, "alone"), (further, "with")):
        shutil.copytree(world / name, folder)
    onward(reopen(first), snug_model(), 2, world / "on").run()
    assert onward(reopen(first), snug_model(), 2, world / "on").progress.step == 2
    assert onward(reopen(first), snug_model(), 2, world / "on", learning_rate=1e-4).progress.step == 0
    onward(reopen(first), snug_model(), 2, world / "on").run()
    after = onward(reopen(further), snug_model(), 2, world / "on")
    assert after.progress.step == 0
    assert torch.equal(after.network.gru.weight_hh_l0, load_network(further / NETWORK).gru.weight_hh_l0)


def test_a_training_of_another_command_is_not_overwritten(world):
    shutil.copytree(world / "with", world / "mine")
    before = (world / "mine" / NETWORK).read_bytes()
    for record in ((world / "mine" / "run.json").read_text(), "{", None):  # as it is, damaged, lost
        (world / "mine" / "run.json").unlink()
        if record is not None:
            (world / "mine" / "run.json").write_text(record)
        with pytest.raises(CaphyError, match="mine: holds a training that was not begun so"):
            onward(reopen(world / "alone"), snug_model(), 2, world / "mine")
    assert (world / "mine" / NETWORK).read_bytes() == before and (world / "mine" / METRICS).is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--lambda-3d", "0"], "--lambda-3d must be positive"),
        (["--scans", "nowhere"], "split.json"),
        (["--worn", "upper"], "has 0 points of the upper garment"),
    ],
)
def test_mistakes_are_explained(world, capsys, arguments, message):
    assert train(world, "wrong", "--steps", "1", *arguments) == 2
    assert message in capsys.readouterr().err


def test_options_for_scans_need_scans(world, capsys):
    for arguments in (["--no-physics"], ["--worn", "lower"]):
        given = [str(world / "run" / "lower.npz"), "-o", str(world / "wrong"), *arguments]
        assert main(["train", *given]) == 2
        assert "--scans" in capsys.readouterr().err
    tube().save(world / "tube.npz")
    given = [str(world / "tube.npz"), str(world / "motion.npz"), "--scans", str(world / "run")]
    assert main(["train", *given, "-o", str(world / "wrong"), "--steps", "1"]) == 2
    assert "--worn" in capsys.readouterr().err


def test_reopening_what_is_no_training_is_refused(tmp_path):
    with pytest.raises(CaphyError, match="caphy train"):
        reopen(tmp_path)


def test_points_follow_from_a_fit(tmp_path):
    """Body and points as 'caphy register points' writes them from a body fit."""
    from caphy.body.bundled import default_body
    from caphy.body.model import BodyModel
    from caphy.register.articulation import Figure, Placement
    from caphy.register.fit import BodyFit
    from caphy.register.points import read_points, read_split, write_points
    from caphy.register.subject import write_subject_body
    from caphy.scan.scan import Scan
    from caphy.scan.scan_set import write_scan_set

    body, rng = default_body(), np.random.default_rng(0)
    displaced = rng.normal(scale=0.003, size=body.v_template.shape)
    figure = Figure.of(body, 0.5 * rng.standard_normal(body.shapedirs.shape[2]), displaced)
    motion = swaying(40, 2)
    placements = tuple(Placement.of(motion.poses[i], motion.transl[i]) for i in (0, 15, 30))
    fit = BodyFit(figure, ("a", "b", "gone"), placements, (), {})
    model = BodyModel.load(write_subject_body(fit, tmp_path))
    bodies = model.pose(motion.poses[[0, 15, 30]], motion.transl[[0, 15, 30]])
    for i in range(3):
        np.testing.assert_allclose(bodies[i], fit.vertices(i), atol=1e-6)

    labels = np.where(body.v_template[:, 1] > 0, 0, 2).astype(np.uint8)
    scans = [Scan(name, fit.vertices(i), body.faces, labels=labels) for i, name in enumerate("ab")]
    found = write_points(fit, write_scan_set(tmp_path / "scans", scans, "someone"), tmp_path)
    assert list(found) == ["gone"] and "has no scan 'gone'" in found["gone"]
    assert sorted(name for side in read_split(tmp_path).values() for name in side) == ["a", "b"]
    (points,) = read_points(tmp_path, "train")
    index = "ab".index(points.name)
    np.testing.assert_allclose(points.lower, fit.vertices(index)[labels == 2], atol=1e-6)
    np.testing.assert_allclose(points.body, fit.vertices(index)[labels == 0], atol=1e-6)
    np.testing.assert_allclose(points.pose, motion.poses[15 * index], atol=1e-6)
    assert not len(points.upper)
    (tmp_path / "split.json").write_text(json.dumps({"train": ["b"], "held_out": ["a"]}))
    write_points(fit, write_scan_set(tmp_path / "scans", scans, "someone"), tmp_path, seed=5)
    assert read_split(tmp_path) == {"train": ["b"], "held_out": ["a"]}
