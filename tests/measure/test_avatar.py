"""Trained avatars against measurements made by their own networks in torch, shifted by a known amount."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shell_avatar import random_network, shell, shell_avatar, wiggle

from caphy.body.bundled import default_body
from caphy.cli import main
from caphy.errors import CaphyError
from caphy.io.bundle import write_bundle
from caphy.io.measurements import Measurement, write_measurement
from caphy.io.poses import PoseSequence
from caphy.measure.avatar import matching_garment, predict_with_avatar
from caphy.measure.comparison import compare
from caphy.measure.pictures import track
from export.head import TOLERANCE  # what a bundle promises of its rounded heads [m]


@pytest.fixture(scope="module")
def measurement() -> Measurement:
    """Every second frame of the T-shirt's network at 60 frames a second is one that the network sees at 30."""
    garment, motion = shell("tshirt"), wiggle(1.0)
    vertices = random_network(garment).stream(motion.poses, motion.transl).astype(np.float64)
    return Measurement("shell", 30.0, vertices=vertices, faces=garment.faces, poses=motion.poses, transl=motion.transl)


def test_an_avatar_agrees_with_its_own_network(measurement):
    bundle = shell_avatar()
    garment = matching_garment(measurement, bundle)
    assert garment.name == "tshirt"
    prediction = predict_with_avatar(measurement, bundle, garment)
    assert prediction.registered
    np.testing.assert_allclose(prediction.vertices, measurement.vertices, atol=TOLERANCE)


def test_a_mesh_is_known_in_whatever_order_its_triangles_come(measurement):
    bundle = shell_avatar()
    turned = replace(measurement, faces=np.roll(measurement.faces, 1, axis=1)[::-1].copy())
    garment = matching_garment(turned, bundle)
    assert garment.name == "tshirt"
    assert predict_with_avatar(turned, bundle, garment).registered


def test_frames_after_the_network_s_last_one_are_not_compared(measurement):
    """At 25 frames a second the last may lie between two of the network's, of which there is but the first."""
    bundle, garment = shell_avatar(), shell_avatar().garment("tshirt")
    motion = PoseSequence(measurement.poses, measurement.transl, measurement.fps).resample(25.0)[:24]
    place = np.arange(24) * 30 / 25
    first, share = place.astype(int), (place % 1)[:, None, None]
    truth = (1 - share) * measurement.vertices[first] + share * measurement.vertices[np.minimum(first + 1, 29)]
    slower = replace(measurement, fps=25.0, vertices=truth, poses=motion.poses, transl=motion.transl)
    prediction = predict_with_avatar(slower, bundle, garment)
    assert list(prediction.frames) == list(range(23))
    assert len(prediction.vertices) == len(prediction.window) == len(prediction.body_vertices) == 23


def test_a_shift_of_the_measurement_is_the_error(measurement):
    higher = replace(measurement, vertices=measurement.vertices + np.array([0, 0.006, 0]))
    bundle = shell_avatar()
    names = bundle.garment("tshirt").mesh
    figures = compare(
        predict_with_avatar(higher, bundle, bundle.garment("tshirt")),
        higher,
        np.array(names.region_names)[names.region],
    ).figures
    assert figures["error"]["median_mm"] == pytest.approx(6.0, abs=0.05)
    assert figures["error"]["down_mean_mm"] == pytest.approx(6.0, abs=0.05)
    assert figures["by_lag"] == []
    assert {row["region"] for row in figures["by_region"]} == {"upper", "lower"}
    assert "running freely" in figures["sentences"][0]
    assert any(row["name"] == "distance to the body" for row in figures["by_covariate"])


def test_a_preroll_warms_the_stream_up_and_other_rates_are_resampled(measurement):
    bundle, garment = shell_avatar(), shell_avatar().garment("tshirt")
    later = replace(
        measurement,
        vertices=measurement.vertices[10:],
        poses=measurement.poses[10:],
        transl=measurement.transl[10:],
        preroll_poses=measurement.poses[:10],
        preroll_transl=measurement.transl[:10],
    )
    np.testing.assert_allclose(predict_with_avatar(later, bundle, garment).vertices, later.vertices, atol=TOLERANCE)
    half = replace(
        measurement,
        fps=15.0,
        vertices=measurement.vertices[::2],
        poses=measurement.poses[::2],
        transl=measurement.transl[::2],
    )
    off = predict_with_avatar(half, bundle, garment).vertices - half.vertices
    assert np.median(np.linalg.norm(off, axis=-1)) < 0.003  # slerp between every second pose is not the motion itself


@pytest.mark.parametrize(("fps", "frames"), [(30.0, 8), (15.0, 4), (120.0, 32)])
def test_rows_belong_together_for_as_long_as_in_the_solvers_windows(measurement, fps, frames):
    """Avatars use all frames of fast recordings, of which eight are too alike to count as a draw of their own."""
    bundle = shell_avatar()
    prediction = predict_with_avatar(replace(measurement, fps=fps), bundle, bundle.garment("tshirt"))
    np.testing.assert_array_equal(prediction.window, prediction.frames // frames)
    assert len(prediction.frames) >= len(measurement) - 1


def test_clouds_and_cloth_without_a_body(measurement):
    bundle, garment = shell_avatar(), shell_avatar().garment("tshirt")
    points = measurement.vertices[:, ::3].reshape(-1, 3)
    count = measurement.vertices[:, ::3].shape[1]
    offsets = count * np.arange(len(measurement) + 1)
    cloud = replace(measurement, vertices=None, faces=None, points=points, offsets=offsets)
    figures = compare(predict_with_avatar(cloud, bundle, garment), cloud).figures
    assert figures["error"]["surface_median_mm"] < 0.02
    assert figures["error"]["down_mean_mm"] is None
    found = compare(predict_with_avatar(cloud, bundle, garment), cloud)
    told, shown = 1e3 * found.errors.distance, track(found).fields["distance"]
    measured = np.isfinite(told)
    assert measured.mean() < 0.8 and np.isfinite(shown).all()
    np.testing.assert_array_equal(shown[measured], told[measured])
    assert shown.max() <= told[measured].max()
    with pytest.raises(CaphyError, match="driven by poses"):
        predict_with_avatar(replace(measurement, poses=None, transl=None), bundle, garment)


def test_another_garments_name_is_refused(measurement):
    bundle = shell_avatar()
    other = next(garment.name for garment in bundle.garments if garment.name != "tshirt")
    with pytest.raises(CaphyError, match=f"its mesh is the avatar's tshirt, not its {other}"):
        matching_garment(measurement, bundle, other)
    assert matching_garment(measurement, bundle, "tshirt").name == "tshirt"


def test_another_body_than_the_avatars_is_said(measurement):
    bundle, garment = shell_avatar(), shell_avatar().garment("tshirt")
    betas = np.zeros(default_body().shapedirs.shape[-1])
    assert not predict_with_avatar(replace(measurement, betas=betas), bundle, garment).cautions
    betas[0] = 3.0
    stout = replace(measurement, betas=betas)
    figures = compare(predict_with_avatar(stout, bundle, garment), stout).figures
    assert any("betas put its joints up to" in sentence for sentence in figures["sentences"])


def test_what_is_doubted_of_a_measurement_is_said_of_avatars_too(measurement, tmp_path, capsys):
    """But not what a solver leaves out: an avatar follows all frames of a fast film. Folders keep their whole names."""
    lost, rest = measurement.vertices.copy(), shell("tshirt").vertices.astype(np.float64)
    lost[3, 7] += (0.0, 0.4, 0.0)
    write_bundle(shell_avatar(), tmp_path / "avatar.v2")
    write_measurement(replace(measurement, name="m", vertices=lost, rest_vertices=rest), tmp_path / "m.npz")
    assert main(["compare", str(tmp_path / "avatar.v2"), str(tmp_path / "m.npz"), "-o", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "compare.html").read_text()
    for said in (capsys.readouterr().out, page):
        assert "Note: m has edges up to" in said and "those of vertex 7 in frame 3" in said
        assert "windows would" not in said
    assert "<h1>avatar.v2 against m</h1>" in page


@pytest.mark.parametrize("option", [("--window", "3"), ("--body", "none.npz"), ("--effect-file", "none.py")])
def test_what_is_for_physics_models_is_refused(measurement, tmp_path, capsys, option):
    write_bundle(shell_avatar(), tmp_path / "avatar")
    write_measurement(measurement, tmp_path / "m.npz")
    words = [str(tmp_path / "avatar"), str(tmp_path / "m.npz"), "-o", str(tmp_path / "out"), *option]
    assert main(["compare", *words]) == 2
    assert f"{option[0]} is for physics models" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["compare", "diagnose", "refit"])
def test_the_bundled_body_has_its_names_for_physics_models(command, measurement, tmp_path, capsys):
    """Next is asked for what the garment's rest shape is, which this measurement does not carry."""
    write_measurement(measurement, tmp_path / "m.npz")
    words = ["snug", str(tmp_path / "m.npz"), "-o", str(tmp_path / "out.json"), "--body"]
    assert main([command, *words, "fine"]) == 2
    assert "rest_vertices" in capsys.readouterr().err
    assert main([command, *words, "finest"]) == 2
    assert "finest: there is no such body model file" in capsys.readouterr().err
