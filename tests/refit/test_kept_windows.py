"""What processes found is found again by the same command, as it was, and by no other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from explicit_cloth import clouds, measured, seen, simulate

from caphy.diagnose.probes import Probes
from caphy.effects.model import Model
from caphy.garment.template import read_npz, write_npz
from caphy.measure.prediction import predict_in_windows
from caphy.measure.scene import Scene
from caphy.refit.clouds import all_registered
from caphy.refit.columns import addition
from caphy.refit.crew import Crew
from caphy.refit.responses import ARRAYS, Response
from caphy.refit.study import Study

MODEL = Model(0.2, {"inertia": {}, "gravity": {}, "strain_stvk": {}})
STIFFER = MODEL.with_effect("strain_stvk", lame_mu=20.0)
COLUMNS = addition("mass_damping")


def _all(scene: Scene, folder: Path | None) -> list[Response]:
    """What a crew tells of three questions, the last of which depends on what the first ones taught it."""
    with Crew(size=1, kept=folder) as crew:
        study = Study([scene], crew=crew)
        told = study.respond(MODEL, COLUMNS, pushes=Probes(MODEL), anew={"start"})
        told += study.respond(STIFFER, COLUMNS, anew={"start"})
        return told + study.respond(MODEL, ())


def test_a_later_crew_tells_what_an_earlier_one_found(tmp_path: Path) -> None:
    scene = Scene.of(measured(*simulate(seconds=1.2), seed=1))
    folder = tmp_path / "kept"
    first = _all(scene, folder)
    files = sorted(folder.iterdir())
    for one, *others in zip(first, _all(scene, None), _all(scene, folder), strict=True):
        for other in others:
            assert (other.scene, other.start) == (one.scene, one.start)
            for name in ARRAYS:
                np.testing.assert_array_equal(getattr(other, name), getattr(one, name))
    assert sorted(folder.iterdir()) == files
    # what is told is what was kept, and goes on from a part of it
    for file in files:
        write_npz(file, {**(arrays := read_npz(file)), "residual": arrays["residual"] + 1.0})
    (lost,) = [file for file in files if read_npz(file)["columns"].shape[-1] == 1]  # of the second question
    lost.unlink()
    moved = [
        float(np.abs(again.residual - one.residual).max())
        for one, again in zip(first, _all(scene, folder), strict=True)
    ]
    assert moved == pytest.approx(np.repeat([1.0, 0.0, 1.0], len(first) // 3).tolist())
    assert sorted(folder.iterdir()) == files
    measurement = scene.measurement
    _all(Scene.of(replace(measurement, vertices=measurement.vertices + 1e-9), scene.garment), folder)
    assert len(list(folder.iterdir())) == 2 * len(files)


def test_windows_are_predicted_once(tmp_path: Path) -> None:
    scene, folder = Scene.of(measured(*simulate(seconds=1.2), seed=1)), tmp_path / "kept"
    found = []
    for model in (MODEL, MODEL, STIFFER):
        with Crew(size=1, kept=folder) as crew:
            found.append(predict_in_windows(scene, model, 20, spread=crew.predict))
        if len(found) == 1:
            files = sorted(folder.iterdir())
            assert len(files) == len(np.unique(found[0].window))
            arrays = read_npz(files[0])
            write_npz(files[0], {**arrays, "positions": arrays["positions"] + 1.0})
    moved = np.abs(found[1].vertices - found[0].vertices).max(axis=(1, 2))
    np.testing.assert_allclose(moved, np.isin(found[0].frames, arrays["frames"]), atol=1e-12)
    assert len(list(folder.iterdir())) == 2 * len(files)


def test_clouds_are_registered_once(tmp_path: Path) -> None:
    scene = Scene.of(measured(*simulate(seconds=1.2), seed=1))
    measurement, faces = scene.measurement, scene.garment.faces
    keys = {"faces": faces, "rest_vertices": scene.garment.vertices, "material": scene.garment.material}
    keys |= {"pinned": measurement.pinned, "pinned_positions": measurement.pinned_positions[:4]}
    cloud = Scene.of(seen(clouds(measurement.vertices[:4], faces, 400, 1e-3), keys, noise_mm=1.0))
    found = []
    for folder in (None, tmp_path / "kept", tmp_path / "kept"):
        with Crew(size=1, kept=folder) as crew:
            found += all_registered([cloud], MODEL, crew=crew)
    (file,) = (tmp_path / "kept").iterdir()
    write_npz(file, {**read_npz(file), "note": np.array("by hand")})
    with Crew(size=1, kept=tmp_path / "kept") as crew:
        (by_hand,) = all_registered([cloud], MODEL, crew=crew)
    assert by_hand.measurement.notes[-1] == "by hand"
    for other in found[1:]:
        assert other.measurement.notes == found[0].measurement.notes
        assert other.measurement.noise_mm == found[0].measurement.noise_mm
        np.testing.assert_array_equal(other.measurement.vertices, found[0].measurement.vertices)
        np.testing.assert_array_equal(other.ends, found[0].ends)
