"""Fine-tuning of garments together: collisions go, the rest stays, in an order told by scans, resumed after a kill."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_scans import posed, sampled, scan
from small_world import swaying, tube

from caphy.body.bundled import default_body
from caphy.cli import main
from caphy.commands.collide import Collide, prepare
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.io.bundle import read_bundle
from caphy.io.poses import write_poses
from caphy.io.training_folder import NETWORK
from caphy.network.files import load_network
from caphy.network.garment_network import GarmentNetwork
from caphy.register.points import ScanPoints
from caphy.training.collide import DEEP, Collider
from caphy.training.layers import Layers
from caphy.training.loop import Schedule, Trainer
from caphy.training.motions import Motions
from caphy.training.objective import Objective
from caphy.training.scans import Scans
from caphy.training.validate import static_drape

SIZES = (1.0, 0.985, 0.975)
"""Each garment is cut narrower than the one that it is worn over."""
NAMES = ["inner", "outer", "coat"]


def sized(size: float) -> Garment:
    garment = tube(16, 7)
    return replace(garment, vertices=garment.vertices * [size, 1, size], attached=0 * garment.attached)


def alone(folder: Path, layer: int) -> Trainer:
    """A small network of one garment, trained alone for a few steps."""
    torch.manual_seed(layer)
    garment, body, model = sized(SIZES[layer]), default_body(), snug_model()
    network = GarmentNetwork(garment.vertices, garment.weights, body.joints, layers=1, width=24)
    motions, held_out = (Motions.of([swaying(60, seed)], body, network.driving, 30.0) for seed in (0, 8))
    potential = Potential(model, Cloth.of(garment, model.density), torch.float32)
    objective = Objective(potential, body, network.template, network.weights, 30.0)
    schedule = Schedule(8, None, 4)
    trainer = Trainer(folder, network, objective, motions, held_out, schedule, 0, say=lambda text: None)
    for step in range(8):
        trainer.step(step / 8)
    trainer.learner.fold(network)
    return trainer


def collider(folder: Path, layers: int, epochs: int, monkeypatch, say=lambda text: None) -> Collider:
    monkeypatch.setattr("caphy.training.collide.LEAST_STEPS", 16)
    trainings = [alone(folder, layer) for layer in range(layers)]
    return Collider(folder, NAMES[:layers], trainings, epochs, streams=4, say=say)


def deep(layers: Layers, networks: list[GarmentNetwork]) -> int:
    """How many vertices lie over 1 mm on the wrong side of another garment, in poses not trained on."""
    unseen, found = swaying(60, 8), 0
    for frame in (5, 25, 45):
        pose, transl = (torch.tensor(part[frame], dtype=torch.float32) for part in (unseen.poses, unseen.transl))
        found += int((layers.depths([static_drape(n, pose, transl).numpy() for n in networks]) > DEEP).sum())
    return found


def test_collisions_of_three_layers_go_also_in_poses_not_trained_on(tmp_path, monkeypatch):
    said = []
    together = collider(tmp_path, 3, 10, monkeypatch, said.append)
    networks = [training.network for training in together.trainings]
    before = deep(together.layers, networks)
    together.run()
    assert before > 100 and deep(together.layers, networks) <= 0.05 * before
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == list(range(16, 161, 16))
    assert lines[-1]["contact_J"] < 0.2 * lines[0]["contact_J"]
    old, new = (int(n) for n in re.findall(r"(\d+) of \d+", said[-1]))
    assert old > 300 and new <= 0.05 * old and new == together.collisions().deep
    for name, network in zip(NAMES, networks, strict=True):
        found = json.loads((tmp_path / name / "metrics.jsonl").read_text())
        assert found["step"] == 160 and np.isfinite(found["validation"]["potential_J"])
        assert torch.equal(load_network(tmp_path / name / NETWORK).head.weight, network.head.weight)


def test_stopped_and_resumed_equals_uninterrupted(tmp_path, monkeypatch):
    whole, broken = (collider(tmp_path / name, 2, 2, monkeypatch) for name in ("whole", "broken"))
    whole.run()
    for _ in range(broken.epoch_steps):
        broken.step()
    broken.save()
    broken.step()  # lost
    again = collider(tmp_path / "broken", 2, 2, monkeypatch)
    again.resume()
    assert again.done == again.epoch_steps and again.before == whole.before
    again.run()
    for one, two in zip(whole.learners.parameters(), again.learners.parameters(), strict=True):
        assert torch.equal(one, two)
    longer = collider(tmp_path / "broken", 2, 5, monkeypatch)
    with pytest.raises(CaphyError, match="steps"):
        longer.resume()
    heavier = snug_model().with_effect("gravity", acceleration=[0.0, -9.0, 0.0])
    monkeypatch.setitem(alone.__globals__, "snug_model", lambda: heavier)
    with pytest.raises(CaphyError, match="other networks, models, motions, scans or another seed"):
        collider(tmp_path / "broken", 2, 2, monkeypatch).resume()


def test_stops_where_a_loss_is_not_finite(tmp_path, monkeypatch):
    together = collider(tmp_path, 2, 1, monkeypatch)
    together.trainings[1].learner.head.bias.data[0] = float("nan")
    with pytest.raises(CaphyError, match="not finite"):
        together.step()


def test_garments_must_share_body_and_motions(tmp_path):
    one, two = alone(tmp_path, 0), alone(tmp_path, 1)
    with pytest.raises(CaphyError, match="at least two garments"):
        Collider(tmp_path, ["one"], [one])
    two.network.joints += 0.01
    with pytest.raises(CaphyError, match="two: was trained on another body"):
        Collider(tmp_path, ["one", "two"], [one, two])
    two.network.joints -= 0.01
    two.track.motions = replace(two.track.motions, names=("another",))
    with pytest.raises(CaphyError, match="two: was trained on other poses"):
        Collider(tmp_path, ["one", "two"], [one, two])


def test_garments_meet_in_the_scans_that_show_them_all(tmp_path, monkeypatch):
    monkeypatch.setattr("caphy.training.collide.LEAST_STEPS", 2)
    one, two = alone(tmp_path, 0), alone(tmp_path, 1)
    for training, shown in ((one, (0, 1, 2)), (two, (1, 2, 3))):
        points = [scan(index, 300) for index in shown]
        training.scans = Scans.of(points, "lower", (), training.objective, training.network.driving)
    together = Collider(tmp_path, ["one", "two"], [one, two])
    for track in together.turns[1]:
        assert track.motions.names == ("scan1", "scan2")
        assert track.motions.starts.tolist() == [0, 1, 2]
        assert np.array_equal(track.motions.poses, np.stack([scan(1).pose, scan(2).pose]))
        shown = [target.sample for target in track.loss.targets]
        assert np.array_equal(shown, [scan(1, 300).lower, scan(2, 300).lower])
    for _ in range(2):
        together.step()
    two.scans = two.scans.only(["scan3"])
    with pytest.raises(CaphyError, match="two: was trained on other poses or scans"):
        Collider(tmp_path, ["one", "two"], [one, two])


def scans_of(folder: Path, hidden: str) -> Path:
    """A run whose scans show the part ``hidden`` only below the pelvis, and the other over it above."""
    other = "upper" if hidden == "lower" else "lower"
    garment = tube(20, 8)
    for index in range(3):
        still = scan(index)
        cloth = posed(garment.vertices, garment.weights, still.pose, still.transl)
        points = sampled(cloth, garment.faces, 2000, index)
        low = points[:, 1] < np.median(points[:, 1])
        parts = {hidden: points[low].astype(np.float32), other: (points[~low] * [1.02, 1, 1.02]).astype(np.float32)}
        ScanPoints(f"scan{index}", still.body, parts["upper"], parts["lower"], still.pose, still.transl).save(
            folder / "points"
        )
    names = [f"scan{i}" for i in range(3)]
    (folder / "split.json").write_text(json.dumps({"train": names[:2], "held_out": names[2:]}))
    replace(garment, name=hidden).save(folder / f"{hidden}.npz")
    short = replace(garment, name=other, vertices=garment.vertices * [1.02, 0.5, 1.02] + [0, 0.07, 0])
    short.save(folder / f"{other}.npz")
    return folder


@pytest.mark.parametrize(("hidden", "device"), [("lower", "cpu"), ("upper", "cpu"), ("lower", "cuda")])
def test_the_command_asks_the_scans_what_is_worn_inside(tmp_path, hidden, device, monkeypatch, capsys):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    monkeypatch.setattr("caphy.training.collide.LEAST_STEPS", 2)
    run = scans_of(tmp_path / "run", hidden)
    write_poses(swaying(60, 0), tmp_path / "motion.npz")
    folders = [str(tmp_path / part) for part in ("upper", "lower")]
    for part, out in zip(("upper", "lower"), folders, strict=True):
        given = [str(run / f"{part}.npz"), str(tmp_path / "motion.npz"), "--scans", str(run), "--steps", "2"]
        assert main(["train", *given, "-o", out, "--device", device]) == 0
    capsys.readouterr()
    arguments = ["collide", *folders, "-o", str(tmp_path / "out"), "--epochs", "1"]
    assert main(arguments) == 0
    other = "upper" if hidden == "lower" else "lower"
    assert f"from the inside out: {hidden}, {other}; 4 steps" in capsys.readouterr().out
    assert main(arguments) == 2
    assert "--resume" in capsys.readouterr().err
    trained = (tmp_path / "out" / hidden / "model.json").read_bytes()
    assert main([*arguments, "--resume"]) == 0
    for part in ("upper", "lower"):
        shutil.copytree(tmp_path / part, tmp_path / "heavy" / part)
        model = Model.load(tmp_path / part / "model.json").with_effect("heavy_hem")
        (tmp_path / "heavy" / part / "model.json").write_text(model.to_json())
    heavy = ["collide", *(str(tmp_path / "heavy" / part) for part in ("upper", "lower")), *arguments[3:]]
    assert main([*heavy, "--resume"]) == 2
    assert "of other networks, models" in capsys.readouterr().err
    assert (tmp_path / "out" / hidden / "model.json").read_bytes() == trained
    if hidden == "lower":
        fine_tuned = [str(tmp_path / "out" / part) for part in ("upper", "lower")]
        assert main(["export", *fine_tuned, "-o", str(tmp_path / "avatar")]) == 0
        was = [{"from_the_inside_out": ["lower", "upper"], "epochs": 1, "seed": 0}]
        for each in read_bundle(tmp_path / "avatar").provenance["garments"].values():
            assert each["training"]["fine_tuned_on_collisions"] == was and each["training"]["steps"] == 2
        together = prepare(Collide((tmp_path / "upper", tmp_path / "lower"), tmp_path / "again", epochs=1))
        random, scans = (tracks[0].streams for tracks in together.turns)
        together.step()  # random poses and scans take turns
        assert random.place.any() and not scans.place.any()
        together.step()
        assert scans.place.any()


def test_mistakes_are_explained(tmp_path, capsys):
    write_poses(swaying(60, 0), tmp_path / "motion.npz")
    sized(1.0).save(tmp_path / "tube.npz")
    inner, out = str(tmp_path / "inner"), ["-o", str(tmp_path / "o")]
    assert main(["train", str(tmp_path / "tube.npz"), str(tmp_path / "motion.npz"), "--steps", "1", "-o", inner]) == 0
    assert main(["collide", inner, str(tmp_path), *out]) == 2
    assert "caphy train" in capsys.readouterr().err
    assert main(["collide", inner, inner, *out]) == 2
    assert "names must differ" in capsys.readouterr().err
    assert main(["collide", inner, inner, "--epochs", "0", *out]) == 2
    assert "--epochs must be positive" in capsys.readouterr().err
    for seed in ("-1", str(1 << 63)):
        assert main(["collide", inner, inner, "--seed", seed, *out]) == 2
        assert "--seed must be from 0" in capsys.readouterr().err
    assert main(["collide", inner, str(tmp_path / "other"), "-o", str(tmp_path)]) == 2
    assert "which is only read; give another folder" in capsys.readouterr().err
