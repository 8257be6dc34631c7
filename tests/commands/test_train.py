"""``caphy train`` from its arguments to the files it leaves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_world import swaying, tube

from caphy.body.bundled import default_body
from caphy.cli import main
from caphy.effects import registry
from caphy.effects.presets import snug_model
from caphy.effects.scaffold import write_scaffold
from caphy.errors import CaphyError
from caphy.garment.template import Garment, write_npz
from caphy.io.poses import write_poses
from caphy.io.training_folder import OPTIONS
from caphy.network.files import load_network
from caphy.register.subject import body_arrays


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    tube().save(tmp_path / "tube.npz")
    (tmp_path / "motions").mkdir()
    for seed in range(2):
        write_poses(swaying(30, seed), tmp_path / "motions" / f"{seed}.npz")
    write_poses(swaying(20, 5), tmp_path / "unseen.npz")
    return tmp_path


def train(folder: Path, *more: str) -> int:
    return main(
        [
            *("train", str(folder / "tube.npz"), str(folder / "motions"), "-o", str(folder / "run"), "--steps", "2"),
            *("--held-out", str(folder / "unseen.npz"), *more),
        ]
    )


def test_trains_and_says_what_it_wrote(inputs, capsys):
    assert train(inputs) == 0
    said = capsys.readouterr().out
    assert "364 frames of 2 clips" in said
    assert f"caphy export {inputs / 'run'}" in said
    run = inputs / "run"
    assert load_network(run / "network.safetensors").fps == 30
    record = json.loads((run / "run.json").read_text())
    assert record["held_out"] == ["unseen.npz"] and record["trained_on"] == ["0.npz", "1.npz"]
    last = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 2 and last["validation"]["deeper_than_1mm_percent"] >= 0
    assert train(inputs) == 2
    assert "--resume" in capsys.readouterr().err
    assert train(inputs, "--resume") == 0
    assert "has had 2 steps already" in capsys.readouterr().out
    assert json.loads((run / "metrics.jsonl").read_text().splitlines()[-1]) == last  # nothing was done again
    kept = (run / "network.safetensors").read_bytes()
    (run / "network.safetensors").unlink()
    assert train(inputs, "--resume") == 0
    assert (run / "network.safetensors").read_bytes() == kept  # the checkpoint has it
    assert train(inputs, "--resume", "--steps", "1") == 0  # nor does its record say that less was done
    assert json.loads((run / "run.json").read_text())["steps"] == 2


def test_goes_on_only_with_what_it_began_with(inputs, capsys, monkeypatch):
    """The same paths, of which one holds something else by now."""
    monkeypatch.setattr(registry, "_from_files", {})  # other tests know nothing of it
    model, file, motion = inputs / "model.json", inputs / "mine.py", inputs / "motions" / "1.npz"
    body, arrays = inputs / "body.npz", body_arrays(default_body())
    write_npz(body, arrays)
    model.write_text(snug_model().to_json())
    write_scaffold("my_resumed_pull", file)
    arguments = "--model", str(model), "--effect-file", str(file), "--body", str(body), "--resume", "--steps", "3"
    assert train(inputs, *arguments[:6]) == 0
    kept = {path: path.read_bytes() for path in (model, file, motion, body)}
    model.write_text(snug_model().with_effect("strain_stvk", lame_mu=33.3).to_json())
    for path, says in (
        (model, "under another model"),
        (file, "with other effect files"),
        (motion, "with other motions"),
        (body, "with other arrays of the body"),
    ):
        if path == file:
            file.write_text(kept[file].decode() + "# changed\n")
        elif path == motion:
            write_poses(swaying(30, 7), motion)
        elif path == body:
            write_npz(body, arrays | {"v_template": 1.01 * arrays["v_template"]})
        assert train(inputs, *arguments) == 2
        assert f"was begun {says}" in capsys.readouterr().err
        path.write_bytes(kept[path])
    assert train(inputs, *arguments) == 0
    assert json.loads((inputs / "run" / "run.json").read_text())["steps"] == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fabric", "gray-interlock", "--model", "m.json"], "not both"),
        (["--steps", "0"], "--steps must be positive"),
        (["--minutes", "-1"], "--minutes must be positive"),
        (["--minutes", "inf"], "--minutes must be positive and finite, got inf"),
        (["nowhere.npz"], "nowhere.npz"),  # held out too
        (["--fabric", "silk-of-spiders"], "silk-of-spiders"),
        (["--resume"], "checkpoint.safetensors"),
    ],
)
def test_mistakes_are_explained(inputs, capsys, arguments, message):
    assert train(inputs, *arguments) == 2
    assert message in capsys.readouterr().err


def test_without_cuda_says_so(inputs, capsys):
    import torch

    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    assert train(inputs, "--device", "cuda") == 2
    assert "--device cpu" in capsys.readouterr().err


def test_another_training_is_not_gone_on_with(inputs, capsys):
    assert train(inputs) == 0
    kept = (inputs / "run" / "run.json").read_text(), (inputs / "run" / "model.json").read_text()
    for more, words in (
        (("--fabric", "gray-interlock"), "was begun with --fabric None, not gray-interlock"),
        (("--seed", "5"), "was begun with --seed 0, not 5"),
    ):
        assert train(inputs, "--resume", *more) == 2
        assert words in capsys.readouterr().err
    path = inputs / "tube.npz"
    before, garment = path.read_bytes(), Garment.load(path)
    for name, other in (
        ("material", 0.99 * garment.material),
        ("weights", np.roll(garment.weights, 1, axis=1)),
        ("attached", 0.99 * np.roll(garment.attached, 1)),
    ):
        replace(garment, **{name: other}).save(path)
        assert train(inputs, "--resume") == 2
        assert f"was begun on a garment of the same mesh and other {name}" in capsys.readouterr().err
    path.write_bytes(before)
    (inputs / "motions" / "1.npz").unlink()
    assert train(inputs, "--resume") == 2
    assert "on other motions, 2 in all, not 1" in capsys.readouterr().err
    assert kept == ((inputs / "run" / "run.json").read_text(), (inputs / "run" / "model.json").read_text())


def test_what_lies_in_the_run_is_remembered_so_that_it_may_be_moved(tmp_path):
    from caphy.commands.begun import copied, option
    from caphy.commands.begun import told as remembered
    from caphy.commands.train import Train

    run, walk = tmp_path / "run", tmp_path / "walk.npz"
    told = remembered(Train(run / "upper.npz", (walk,), run / "train" / "upper", scans=run, body=run / "body.npz"))
    assert (told["garment"], told["body"], told["scans"]) == ("../../upper.npz", "../../body.npz", "../..")
    assert told["poses"] == [str(walk)]
    moved = tmp_path / "elsewhere" / "train" / "upper"
    assert option("Path", told["garment"], moved) == tmp_path / "elsewhere" / "upper.npz"
    assert option("tuple[Path, ...]", told["poses"], moved) == (walk,)
    folder = run / "train" / "upper"
    folder.mkdir(parents=True)
    (folder / OPTIONS).write_text(json.dumps(told))
    for to, garment in ((run / "a" / "b" / "upper", "../../../upper.npz"), (tmp_path / "out", str(run / "upper.npz"))):
        again = json.loads(copied(folder, to))
        assert again["garment"] == garment and again["poses"] == [str(walk)] and again["seed"] == told["seed"]
        assert option("Path", again["scans"], to) == run
    alone = remembered(Train(tmp_path / "tube.npz", (walk,), tmp_path / "alone"))
    assert alone["garment"] == str(tmp_path / "tube.npz")


def test_what_comes_with_caphy_is_remembered_by_name(inputs):
    """Wherever it is installed: the same command goes on elsewhere."""
    from caphy.commands.begun import option
    from caphy.commands.begun import told as remembered
    from caphy.commands.train import Train
    from caphy.evaluate.learnt_from import learnt_from
    from caphy.io.bundled import bundled

    avatar = bundled(Path("default"))
    told = remembered(Train(bundled(Path("tshirt")), (), inputs / "run", transfer=avatar))
    assert (told["garment"], told["transfer"]) == ("caphy:garments/tshirt.npz", "caphy:avatars/default")
    assert option("Path | None", told["transfer"], inputs / "run") == avatar
    (inputs / "run").mkdir()
    (inputs / "run" / "options.json").write_text(json.dumps(told))
    assert not list(learnt_from(inputs / "run"))  # the default avatar knows no scans


def test_a_body_that_comes_along_is_found_again_by_name(inputs, capsys):
    """By what goes on with the training, looks at it, and makes an avatar of it, which needs no licence."""
    from caphy.body.bundled import default_body_path
    from caphy.commands.begun import own_body
    from caphy.commands.train import reopen
    from caphy.io.bundle import read_bundle

    run = inputs / "run"
    assert train(inputs, "--body", "fine") == 0
    assert f"caphy export {run} -o avatars/run" in capsys.readouterr().out
    for name in ("options.json", "run.json"):
        assert json.loads((run / name).read_text())["body"] == "caphy:body_fine.npz"
    assert own_body(run) == default_body_path("fine")
    assert train(inputs, "--body", "fine", "--resume", "--steps", "3") == 0
    assert len(reopen(run).objective.body.v_template) == len(default_body("fine").v_template)
    assert main(["validate", str(run), "--seconds", "0.2", "--frames", "60"]) == 0
    assert train(inputs, "--body", "medium", "--resume", "--steps", "4") == 2
    assert "body_fine.npz, not " in capsys.readouterr().err
    assert main(["export", str(run), "--body", "medium", "-o", str(inputs / "avatar")]) == 0
    assert len(read_bundle(inputs / "avatar").body.vertices) == len(default_body("medium").v_template)


def test_a_training_goes_on_with_motions_that_were_renamed(inputs, capsys):
    assert train(inputs) == 0
    (inputs / "motions" / "1.npz").rename(inputs / "motions" / "walk.npz")
    assert train(inputs, "--resume", "--steps", "3") == 0
    assert json.loads((inputs / "run" / "run.json").read_text())["trained_on"] == ["0.npz", "walk.npz"]
    write_poses(swaying(30, 7), inputs / "motions" / "walk.npz")
    assert train(inputs, "--resume", "--steps", "4") == 2
    assert "with other motions, which have changed since" in capsys.readouterr().err


def test_a_training_is_opened_again_on_motions_that_were_moved(inputs):
    from caphy.commands.train import reopen

    assert train(inputs) == 0
    (inputs / "motions").rename(inputs / "elsewhere")
    (inputs / "unseen.npz").rename(inputs / "elsewhere" / "unseen.npz")
    with pytest.raises(CaphyError, match="motions"):
        reopen(inputs / "run")
    trainer = reopen(inputs / "run", (inputs / "elsewhere",))
    assert len(trainer.track.motions) == 364
    write_poses(swaying(30, 7), inputs / "elsewhere" / "1.npz")
    with pytest.raises(CaphyError, match=r"run: was trained on other motions than these 2; give the same with --poses"):
        reopen(inputs / "run", (inputs / "elsewhere",))


def test_a_training_is_opened_again_on_the_garment_that_is_kept_beside_its_network(inputs):
    """The file that it began with may be another cut since, or gone."""
    from caphy.commands.train import reopen

    assert train(inputs) == 0
    (inputs / "tube.npz").unlink()
    trainer = reopen(inputs / "run")
    kept = Garment.load(inputs / "run" / "garment.npz")
    np.testing.assert_array_equal(trainer.objective.potential.cloth.faces, kept.faces)


def test_a_training_whose_motions_are_shared_out_otherwise_is_not_opened_again(inputs):
    """Or it would be on frames that it holds out."""
    from caphy.commands.train import reopen

    assert train(inputs) == 0
    told = json.loads((inputs / "run" / "options.json").read_text())
    told["held_out"] = []
    (inputs / "run" / "options.json").write_text(json.dumps(told))
    with pytest.raises(CaphyError, match="was trained on other motions"):
        reopen(inputs / "run")


def test_held_out_frames_are_not_trained_on(inputs, monkeypatch):
    from caphy.commands.train import Train, _clips

    monkeypatch.chdir(inputs)
    trained, unseen = _clips(Train(Path("tube.npz"), (Path("motions"),), Path("run")))
    assert [len(clip) for clip in trained] == [30, 24] and [len(clip) for clip in unseen] == [6]
    assert [Path(clip.source).name for clip in (*trained, *unseen)] == ["0.npz", "1.npz#0-24", "1.npz#24-30"]
    both = _clips(Train(Path("tube.npz"), (Path("motions"),), Path("run"), held_out=(inputs / "motions" / "1.npz",)))
    assert [Path(clip.source).name for clip in both[0]] == ["0.npz"]


def test_parts_of_one_recording_are_on_one_side(monkeypatch):
    """What tracking errors cut apart is one motion; the sixth recording is held out with all its parts."""
    from caphy.commands.train import Train, _clips
    from caphy.io.poses.parts import file_of, part

    takes = [replace(swaying(40, seed), source=f"{seed}.npz") for seed in range(7)]
    cut = [piece for take in takes for piece in (part(take, 0, 20), part(take, 21, 40))]
    monkeypatch.setattr("caphy.training.motions.find_poses", lambda _: cut)
    options = Train(Path("tube.npz"), (Path("motions"),), Path("run"))
    trained, unseen = _clips(options)
    assert [clip.source for clip in unseen] == ["5.npz#0-20", "5.npz#21-40"]
    assert {file_of(clip.source) for clip in trained} == {f"{seed}.npz" for seed in (0, 1, 2, 3, 4, 6)}
    monkeypatch.setattr("caphy.training.motions.find_poses", lambda _: cut[:7])  # of four recordings
    trained, unseen = _clips(options)
    assert [clip.source for clip in unseen] == ["3.npz#16-20"]
    assert [clip.source for clip in trained] == [*(clip.source for clip in cut[:6]), "3.npz#0-16"]


def test_resumed_without_a_length_it_has_the_one_it_began_with(inputs, capsys):
    """Not 45 minutes, with the rate back at its start."""
    assert train(inputs) == 0
    words = ["train", str(inputs / "tube.npz"), str(inputs / "motions"), "-o", str(inputs / "run"), "--resume"]
    assert main([*words, "--held-out", str(inputs / "unseen.npz")]) == 0
    assert "has had 2 steps already" in capsys.readouterr().out
    assert json.loads((inputs / "run" / "run.json").read_text())["steps"] == 2
