"""What docs/onnx.md tells runs as it stands there, and gives the service's meshes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from shell_avatar import wiggle

from caphy.io.bundle import read_bundle
from service.engine import GarmentEngine

ROOT = Path(__file__).parents[2]


def test_the_example_runs_and_gives_the_services_meshes(monkeypatch):
    monkeypatch.chdir(ROOT)
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/onnx.md").read_text(encoding="utf-8"), re.S)
    told: dict = {}
    exec(compile(example, "docs/onnx.md", "exec"), told)
    bundle = read_bundle(told["folder"])
    engine = GarmentEngine(bundle.garment("tshirt"))
    vertices, state = engine.run(told["poses"], told["transl"], engine.initial_state())
    np.testing.assert_allclose(told["vertices"], vertices, atol=1e-5)
    np.testing.assert_allclose(told["state"], state, atol=1e-4)
    np.testing.assert_array_equal(told["faces"], bundle.garment("tshirt").mesh.faces)


def test_streams_are_laid_out_as_told(monkeypatch):
    """The first frames of all streams before their second ones, states one after another."""
    engine = GarmentEngine(read_bundle(ROOT / "caphy/data/avatars/default").garment("trousers"))
    motions = [wiggle(0.5, seed=seed) for seed in (1, 2)]
    apart = [engine.run(m.poses.astype("f4"), m.transl.astype("f4"), engine.initial_state()) for m in motions]
    poses = np.stack([m.poses for m in motions], axis=1).reshape(-1, 55, 3).astype("f4")
    transl = np.stack([m.transl for m in motions], axis=1).reshape(-1, 3).astype("f4")
    states = np.zeros(2 * engine.state_size, "f4")
    inputs = {"poses": poses, "transl": transl, "state": states}
    vertices, after = engine._session.run(["vertices", "next_state"], inputs)
    for number, (alone, state) in enumerate(apart):
        np.testing.assert_allclose(vertices[number::2], alone, atol=2e-5)
        np.testing.assert_allclose(after.reshape(2, -1)[number], state, atol=1e-4)
