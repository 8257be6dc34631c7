"""Going on from a trained network: read back from what serves it, in coordinates of another model's stiffness."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_world import small_trainer, swaying, tube

from caphy.body.bundled import default_body
from caphy.effects import registry
from caphy.effects.base import Effect, Parameter
from caphy.effects.cloth import Cloth
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle, read_bundle, write_bundle
from caphy.measure.avatar import run_graph
from caphy.network.files import save_network
from caphy.network.garment_network import GarmentNetwork
from caphy.training.blind_spots import blind_spots
from caphy.training.initial import read_initial
from caphy.training.learner import Learner, _without_contact, stiffness
from caphy.training.streams import Windows
from export.avatar import avatar_bundle, bundled_garment

DEFAULT = Path(__file__).parents[2] / "caphy" / "data" / "avatars" / "default"


@pytest.fixture(scope="module")
def bundle() -> AvatarBundle:
    """The tube with a network of random weights, exported."""
    torch.manual_seed(1)
    garment, body = tube(), default_body()
    network = GarmentNetwork(garment.vertices, garment.weights, body.joints, layers=2, width=24)
    torch.nn.init.normal_(network.head.weight, std=0.005)
    torch.nn.init.normal_(network.head.bias, std=0.01)
    worn = bundled_garment(garment, network, [swaying(20, 0)], [swaying(20, 1)])
    return avatar_bundle("little", body, [worn], fps=30.0, provenance={"garments": {}})


def test_a_network_comes_back_from_the_graph_that_serves_it(bundle, tmp_path):
    write_bundle(bundle, tmp_path / "avatar")
    initial = read_initial(tmp_path / "avatar", tube())
    motion = swaying(40, 7)
    served = run_graph(bundle.garments[0], motion.poses, motion.transl)
    np.testing.assert_allclose(initial.network.stream(motion.poses, motion.transl), served, atol=2e-6)
    assert initial.record["avatar"] == "little" and initial.record["garment"] == "tube"


def test_the_bundled_avatar_can_be_trained_further():
    """Its graphs come from an export of long ago."""
    for garment in read_bundle(DEFAULT).garments:
        worn = replace(tube(), name=garment.name)
        worn = replace(
            worn,
            vertices=garment.mesh.vertices.astype(float),
            faces=garment.mesh.faces,
            **{name: np.zeros(len(garment.mesh.vertices)) for name in ("layer_thickness", "attached")},
            regions=np.full(len(garment.mesh.vertices), "x"),
            weights=garment.mesh.dense_weights(),
            material=np.zeros((len(garment.mesh.faces), 3, 2)),
        )
        initial, motion = read_initial(DEFAULT, worn), swaying(10, 3)
        served = run_graph(garment, motion.poses, motion.transl)
        np.testing.assert_allclose(initial.network.stream(motion.poses, motion.transl), served, atol=1e-5)
        assert initial.model["density_kg_per_m2"] == pytest.approx(snug_model().density)


def test_refuses_what_is_no_network_of_the_garment(bundle, tmp_path):
    write_bundle(bundle, tmp_path / "avatar")
    with pytest.raises(CaphyError, match=r"84 vertices.*give the garment npz"):
        read_initial(tmp_path / "avatar", replace(tube(), vertices=tube().vertices + 0.01))
    with pytest.raises(CaphyError, match="neither an avatar"):
        read_initial(tmp_path, tube())
    initial = read_initial(tmp_path / "avatar", tube())
    initial.require_joints(default_body().joints)
    with pytest.raises(CaphyError, match="another body"):
        initial.require_joints(default_body().joints * 1.01)


def test_refuses_a_graph_of_someone_else(bundle, tmp_path):
    garment = replace(bundle.garments[0], onnx=b"not a graph")
    write_bundle(replace(bundle, garments=(garment,)), tmp_path / "avatar")
    with pytest.raises(CaphyError, match="is not one that 'caphy export' writes"):
        read_initial(tmp_path / "avatar", tube())


def test_the_learner_starts_as_the_network_is(make_trainer):
    network = make_trainer().network
    torch.nn.init.normal_(network.head.weight, std=0.01)
    torch.nn.init.normal_(network.head.bias, std=0.01)
    model = snug_model().with_effect("body_friction").with_effect("air_drag_normal", coefficient=5.0)
    potential = Potential(model, Cloth.of(tube(), model.density))
    learner = Learner(network, stiffness(potential, 30.0))
    features, hidden = torch.randn(2, 3, network.gru.input_size), torch.zeros(2, 2, 24)
    torch.testing.assert_close(learner(features, hidden)[0], network.offsets(features, hidden)[0], rtol=1e-4, atol=1e-6)


def test_what_was_read_can_be_trained_on_a_gpu(bundle, tmp_path):
    """cuDNN differentiates recurrent layers in training mode alone; networks that were read are not in it."""
    write_bundle(bundle, tmp_path / "avatar")
    network = read_initial(tmp_path / "avatar", tube()).network
    potential = Potential(snug_model(), Cloth.of(tube(), snug_model().density))
    assert Learner(network.eval(), stiffness(potential, 30.0)).gru.training


def test_training_meets_the_clock_of_its_clip(tmp_path):
    """Windows of the second clip are met as late as they are in it."""
    trainer = small_trainer(tmp_path)
    start = int(trainer.track.motions.starts[1])
    frames = np.array([start + np.arange(3, 8), np.arange(10, 15)])
    windows = Windows(frames, frames[:, 0] - 1, np.array([False] * 2), np.array([False] * 2), np.array([[4, 0]] * 2))
    past = type(trainer.track.past)(*(field[:2] for field in (trainer.track.past.before, trainer.track.past.previous)))
    scene, _ = trainer.objective.scene(trainer.track.motions, windows, torch.zeros(2, 5, len(tube().vertices), 3), past)
    np.testing.assert_allclose(scene.step.time[..., 0] * 30, [[7, 3], [14, 10]], atol=1e-5)


def test_what_the_network_cannot_see_is_named():
    def found(*names: str) -> dict[str, str]:
        model = snug_model()
        for name in names:
            model = model.with_effect(name)
        return blind_spots(Potential(model, Cloth.of(tube(), model.density), torch.float32))

    assert found() == {}
    assert found("air_drag_normal", "body_friction", "heavy_hem", "viscous_damping", "pressure") == {}
    assert found("wind_normal", "air_drag_normal") == {"wind_normal": "heading"}
    assert found("gust") == {"gust": "heading and time"}
    swirl = snug_model().with_effect("wind_field", gradient=((0, 0, 1.0), (0, 0, 0), (-1.0, 0, 0)))
    assert blind_spots(Potential(swirl, Cloth.of(tube(), swirl.density))) == {"wind_field": "place"}


def test_a_run_is_a_start_too(tmp_path):
    trainer = small_trainer(tmp_path / "run")
    save_network(trainer.network, tmp_path / "run" / "network.safetensors")
    (tmp_path / "run" / "run.json").write_text(json.dumps({"betas": [0.5]}))
    (tmp_path / "run" / "model.json").write_text(snug_model().to_json())
    initial = read_initial(tmp_path / "run", tube())
    assert initial.betas == (0.5,) and initial.record["run"] == "run"
    for one, two in zip(initial.network.parameters(), trainer.network.parameters(), strict=True):
        assert torch.equal(one, two)


class Sticky(Effect):
    """As much drag as there is friction, E = dt mu m / 2 |v|^2 [J] per vertex."""

    name = "sticky"
    element = "vertex"
    parameters = {"factor": Parameter(1.0, "1/s", doc="how much")}
    reference = "a test's own"
    needs_step = True
    borrows = ("body_friction",)


def test_without_contact_nothing_is_left_that_follows_from_it(monkeypatch):
    monkeypatch.setattr(registry, "_from_files", {"sticky": Sticky})
    model = snug_model().with_effect("body_friction").with_effect("sticky")
    assert set(_without_contact(model).effects) == set(snug_model().effects) - {"body_contact"}
