"""``caphy train --init``: an avatar learns an effect that it was not trained with, and compare sees its error fall."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from small_world import swaying, tube

from caphy.body.bundled import default_body
from caphy.cli import main
from caphy.commands.train import reopen
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.io.measurements import Measurement, write_measurement
from caphy.io.poses import write_poses
from caphy.network.files import load_network
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton
from caphy.training.reference import solve


def heavy() -> Model:
    """The tube's lower edge weighted down, and thick air."""
    model = snug_model().with_effect("heavy_hem", line_density=(0.1, 0, 0, 0))
    model = model.with_effect("air_drag_normal", coefficient=20.0)
    return model.revised(snug_model(), "weights sewn into the hem", data=["unseen"])


def measured(folder: Path, model: Model) -> Path:
    """The solver's motion of the tube."""
    motion = BodyMotion(default_body(), swaying(21, 5), tube())
    vertices = solve(Newton(Potential(model, Cloth.of(tube(), model.density))), motion).numpy()
    poses = motion.poses
    return write_measurement(
        Measurement(
            name="unseen", fps=30.0, vertices=vertices, faces=tube().faces, rest_vertices=tube().vertices,
            poses=poses.poses[1:], transl=poses.transl[1:],
        ),
        folder / "unseen.npz",
    )  # fmt: skip


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tmp_path = tmp_path_factory.mktemp("world")
    tube().save(tmp_path / "tube.npz")
    write_poses(swaying(40, 0), tmp_path / "motion.npz")
    (tmp_path / "heavy.json").write_text(heavy().to_json())
    assert train(tmp_path, "run", "--steps", "80") == 0
    assert main(["export", str(tmp_path / "run"), "-o", str(tmp_path / "avatar")]) == 0
    return tmp_path


def train(folder: Path, name: str, *more: str) -> int:
    return main(["train", str(folder / "tube.npz"), str(folder / "motion.npz"), "-o", str(folder / name), *more])


def median_error(folder: Path, avatar: str, measurement: Path) -> float:
    assert main(["compare", str(folder / avatar), str(measurement), "-o", str(folder / "compared")]) == 0
    (figures,) = json.loads((folder / "compared" / "compare.json").read_text())["comparisons"]
    return figures["error"]["median_mm"]


def test_an_avatar_learns_a_new_effect(world, capsys):
    measurement = measured(world, heavy())
    before = median_error(world, "avatar", measurement)
    model = ["--model", str(world / "heavy.json")]
    assert train(world, "tuned", "--init", str(world / "avatar"), *model, "--steps", "80") == 0
    assert main(["export", str(world / "tuned"), "-o", str(world / "avatar2")]) == 0
    assert median_error(world, "avatar2", measurement) < 0.6 * before

    record = json.loads((world / "tuned" / "run.json").read_text())
    assert record["init"]["avatar"] == "avatar" and len(record["init"]["graph_sha256"]) == 64
    assert Model.load(world / "tuned" / "model.json").history == heavy().history
    capsys.readouterr()
    assert main(["effects", "history", str(world / "avatar2")]) == 0
    assert "weights sewn into the hem" in capsys.readouterr().out
    # Without --model it goes on with the model that the avatar learnt.
    assert train(world, "on", "--init", str(world / "avatar2"), "--steps", "1") == 0
    assert Model.load(world / "on" / "model.json") == heavy()


def test_mistakes_with_init_are_explained(world, capsys):
    tube(around=12).save(world / "other.npz")
    for start, garment, message in (
        ("avatar", "other.npz", "has no network of the garment"),
        ("nowhere", "tube.npz", "neither an avatar"),
    ):
        inputs = [str(world / garment), str(world / "motion.npz"), "-o", str(world / "wrong")]
        assert main(["train", *inputs, "--init", str(world / start), "--steps", "1"]) == 2
        assert message in capsys.readouterr().err
    assert train(world, "wrong", "--init", str(world / "avatar"), "--betas", "3.0", "--steps", "1") == 2
    assert "trained on another body" in capsys.readouterr().err


def test_a_garment_of_another_mesh_begins_as_an_avatars(world, capsys):
    tube(around=18, rings=8).save(world / "finer.npz")
    inputs = [str(world / "finer.npz"), str(world / "motion.npz"), "-o", str(world / "begun"), "--steps", "2"]
    assert main(["train", *inputs, "--transfer", str(world / "avatar")]) == 0
    assert "begins as the tube of the avatar avatar" in capsys.readouterr().out
    record = json.loads((world / "begun" / "run.json").read_text())
    assert record["init"]["transferred_from"] == "avatar" and record["init"]["apart_mm"] < 5
    # What is trained further is what was trained, not what it began as.
    kept, begun = load_network(world / "begun" / "network.safetensors"), load_network(world / "run/network.safetensors")
    assert torch.equal(reopen(world / "begun").network.head.weight, kept.head.weight)
    assert (kept.gru.weight_ih_l1 - begun.gru.weight_ih_l1).abs().max() < 0.01
    assert main(["train", *inputs, "--transfer", "default", "--init", "default"]) == 2
    assert "give either --init" in capsys.readouterr().err


def test_winds_that_the_network_cannot_see_are_named(world, capsys):
    (world / "wind.json").write_text(snug_model().with_effect("wind_normal").to_json())
    assert train(world, "windy", "--model", str(world / "wind.json"), "--steps", "1") == 0
    assert "wind_normal depends on heading" in capsys.readouterr().out


def test_a_model_of_cloth_on_pins_is_learned_on_a_body(world, capsys):
    """As 'caphy refit' of a square writes it: without the contact that a garment's network must know."""
    own = Model.load(world / "run" / "model.json").with_effect("body_contact", distance=0.007)
    (world / "run" / "model.json").write_text(own.to_json())
    bare = heavy().without_effect("body_contact").without_effect("attachment")
    (world / "bare.json").write_text(bare.to_json())
    capsys.readouterr()
    for name, more, distance in (("fine", ("--init", str(world / "run")), 0.007), ("fresh", (), 0.004)):
        assert train(world, name, *more, "--model", str(world / "bare.json"), "--steps", "1") == 0
        assert "body_contact and attachment are taken from" in capsys.readouterr().out
        learned = Model.load(world / name / "model.json")
        assert learned.effects["body_contact"].get("distance", 0.004) == distance
        assert "attachment" in learned.effects and "air_drag_normal" in learned.effects
