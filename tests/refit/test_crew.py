"""Windows rolled out by several processes are those of one, and a user's own effect is known to all."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from explicit_cloth import clouds, measured, seen, simulate

from caphy.diagnose.probes import Probes
from caphy.effects import registry
from caphy.effects.model import Model
from caphy.effects.scaffold import write_scaffold
from caphy.errors import CaphyError
from caphy.measure.prediction import predict_in_windows
from caphy.measure.scene import Scene
from caphy.refit.clouds import all_registered
from caphy.refit.columns import addition
from caphy.refit.crew import Crew
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.of(measured(*simulate(seconds=1.2), seed=1))


def test_a_crew_finds_what_one_process_does(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_from_files", {})
    file = tmp_path / "lift.py"
    write_scaffold("lift", file)
    registry.register_file(file)
    columns, told = (*addition("mass_damping"), *addition("lift")), []
    scenes = [scene, scene]
    alone = Study(scenes)
    with Crew([file], size=2) as crew:
        shared = Study(scenes, progress=lambda *said: told.append(said), crew=crew)
        found = shared.respond(MODEL, columns, "trying", Probes(MODEL))
    wanted = alone.respond(MODEL, columns, "trying", Probes(MODEL))
    assert [(each.scene, each.start) for each in found] == [(each.scene, each.start) for each in wanted]
    for one, other in zip(found, wanted, strict=True):
        for field in ("residual", "columns", "nuisance", "error"):
            wanted_there = getattr(other, field)  # sums of two threads differ in their last bits from those of one
            scale = np.nanmax(np.abs(wanted_there), initial=0.0)
            np.testing.assert_allclose(getattr(one, field), wanted_there, rtol=0, atol=1e-9 * scale)
    assert told[-1] == ("trying", len(wanted), len(wanted))


def test_some_windows_ask_the_processes_that_know_them(scene):
    """Where the mesh's error was told of another model, what is left does not hang on how many processes there are."""
    stiffer, left = Model(0.2, {**MODEL.effects, "strain_stvk": {"lame_mu": 300.0}}), []
    with Crew(size=2) as crew:
        for who in (None, crew):
            study = Study([scene], crew=who, mesh=1.0)
            study.respond(MODEL, (), anew={"solver"})
            some = study.some(range(1, sum(map(len, study.starts)), 2))
            some.respond(stiffer, (), anew={"solver"})
            left.append([each.residual for each in study.respond(MODEL, ())])
    for one, other in zip(*left, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


def test_windows_predicted_by_a_crew_are_those_of_one_process(scene):
    told = []
    with Crew(size=2) as crew:
        shared = predict_in_windows(scene, MODEL, 12, lambda *said: told.append(said), crew.predict)
        with pytest.raises(CaphyError, match="no effect"):
            list(crew.predict(scene, Model(0.2, {"nonsense": {}}), 12, [1]))
    alone = predict_in_windows(scene, MODEL, 12)
    for each in ("frames", "lag", "window", "converged"):
        np.testing.assert_array_equal(getattr(shared, each), getattr(alone, each))
    for each in ("vertices", "step_error", "mesh_error", "start_error"):
        found = getattr(shared, each)
        assert np.isfinite(found).any()
        np.testing.assert_allclose(found, getattr(alone, each), rtol=0, atol=1e-9)
    whats, dones, totals = zip(*told, strict=True)
    assert set(whats) == {"rolling out"}
    assert len(set(totals)) == 1
    assert sorted(set(dones)) == list(dones)
    assert dones[-1] == totals[-1]


def test_what_goes_wrong_in_a_process_is_said_here(scene):
    with Crew(size=1) as crew:
        study = Study([scene], crew=crew)
        with pytest.raises(CaphyError, match="no effect"):
            study.respond(Model(0.2, {"nonsense": {}}), addition("mass_damping"))


def test_each_process_keeps_to_one_thread(monkeypatch):
    """Threads of several processes that wait for each other take four times as long."""
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with Crew(size=1) as crew:
        (only,) = crew._each
        assert only.submit(torch.get_num_threads).result() == 1
        assert only.submit(os.getenv, "OMP_NUM_THREADS").result() == "1"
    assert os.environ["OMP_NUM_THREADS"] == "3"


def test_clouds_registered_by_a_crew_are_those_of_one_process(scene):
    """In the order given, the one that needs no registering among them."""
    measurement, faces = scene.measurement, scene.garment.faces
    keys = {"faces": faces, "rest_vertices": scene.garment.vertices, "material": scene.garment.material}
    keys |= {"pinned": measurement.pinned, "pinned_positions": measurement.pinned_positions[:8]}
    some = [seen(clouds(measurement.vertices[:8], faces, 800, 1e-3, seed), keys, noise_mm=1.0) for seed in (0, 1)]
    scenes, told = [Scene.of(some[0]), scene, Scene.of(some[1])], []
    with Crew(size=2) as crew:
        found = all_registered(scenes, MODEL, lambda *said: told.append(said), crew)
        with pytest.raises(CaphyError, match="near the first cloud"):
            all_registered([Scene.of(replace(some[0], points=some[0].points + 1.0))], MODEL, crew=crew)
    assert found[1] is scene
    assert told == [("registering", 1, 2), ("registering", 2, 2)]
    for one, other in zip(found, all_registered(scenes, MODEL), strict=True):
        assert one.slides == other.slides
        np.testing.assert_allclose(one.measurement.vertices, other.measurement.vertices, rtol=0, atol=1e-9)
    assert found[2].unregistered.measurement is some[1]
