"""Metrics against plain loops, closed forms and another package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist
from scipy.stats import foldnorm

from caphy.io.measurements import Measurement
from caphy.measure import errors as metrics
from caphy.measure.comparison import Comparison, compare
from caphy.measure.covariates import covariates
from caphy.measure.errors import surface_errors, vertex_errors
from caphy.measure.pictures import track
from caphy.measure.prediction import Prediction


def sheet(count: int = 5) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(0, 0.4, count), np.linspace(0, 0.4, count))
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + count + 1, corner + count
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])  # normals along +z
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1), faces


def predicted(vertices: np.ndarray, faces: np.ndarray, registered: bool = True) -> Prediction:
    rows = np.arange(len(vertices))
    return Prediction(rows, vertices, faces, registered, rows, rows // 2, np.ones(len(rows), bool))


def bumpy(seed: int, frames: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rest, faces = sheet()
    return rest + np.random.default_rng(seed).normal(0, 0.01, (frames, *rest.shape)), faces


def test_a_shifted_sheet_has_the_errors_of_the_shift():
    rest, faces = sheet()
    model = (rest + np.array([0.003, -0.004, 0.012]))[None]
    errors = vertex_errors(predicted(model, faces), Measurement("m", 30.0, vertices=rest[None], faces=faces))
    np.testing.assert_allclose(errors.distance, 0.013)
    np.testing.assert_allclose(errors.normal, 0.012)  # the model lies outside, on the side of the normals
    np.testing.assert_allclose(errors.along, 0.005)
    np.testing.assert_allclose(errors.down, 0.004)  # and too low


def test_holes_count_nowhere():
    model, faces = bumpy(0)
    measured = bumpy(1)[0]
    measured[1, 3:9], measured[2] = np.nan, np.nan
    seen = np.ones(measured.shape[:2], bool)
    seen[0, 5] = False
    measurement = Measurement("m", 30.0, vertices=measured, faces=faces, visibility=seen)
    errors = vertex_errors(predicted(model, faces), measurement)
    surface = surface_errors(predicted(model, faces), measurement)
    for row in range(3):
        for v in range(len(model[0])):
            hole = row == 2 or (row == 1 and 3 <= v < 9) or (row == 0 and v == 5)
            expected = np.nan if hole else float(np.sqrt(sum((model[row, v] - measured[row, v]) ** 2)))
            np.testing.assert_allclose(errors.distance[row, v], expected, rtol=1e-12)
    assert len(surface.signed[0]) == 24
    assert len(surface.signed[1]) == 19
    assert np.isnan(surface.chamfer[2])


def test_surface_distances_agree_with_trimesh_and_chamfer_with_a_loop():
    model, faces = bumpy(0)
    clouds = [np.random.default_rng(k).uniform(-0.05, 0.45, (30 + k, 3)) for k in range(3)]
    offsets = np.concatenate([[0], np.cumsum([len(c) for c in clouds])])
    measurement = Measurement("m", 30.0, points=np.concatenate(clouds), offsets=offsets)
    surface = surface_errors(predicted(model, faces, False), measurement)
    for row, cloud in enumerate(clouds):
        mesh = trimesh.Trimesh(model[row], faces, process=False)
        closest, distance, triangle = trimesh.proximity.closest_point_naive(mesh, cloud)
        np.testing.assert_allclose(np.abs(surface.signed[row]), distance, atol=1e-12)
        above = ((cloud - closest) * mesh.face_normals[triangle]).sum(1)
        clear = np.abs(above) > 0.5 * distance  # beside the sheet the sign is a matter of taste
        assert (np.sign(surface.signed[row][clear]) == np.sign(above[clear])).all()
        reverse = cdist(model[row], cloud).min(axis=1)
        np.testing.assert_allclose(surface.chamfer[row], 0.5 * (distance.mean() + reverse.mean()), atol=1e-12)


def test_points_are_gathered_at_their_nearest_vertex():
    rest, faces = sheet()
    points = np.array([[0.0, 0, 0.01], [0.004, 0, 0.03], [0.4, 0.4, -0.02]])
    measurement = Measurement("m", 30.0, points=points, offsets=np.array([0, 3]))
    surface = surface_errors(predicted(rest[None], faces, False), measurement)
    assert surface.vertex[0, 0] == pytest.approx(0.02)
    assert surface.vertex[0, 24] == pytest.approx(-0.02)
    assert np.isfinite(surface.vertex).sum() == 2


def compared(off: float, points: int = 2000, sag: float = 0.0) -> Comparison:
    """A sheet that the model has ``off`` [m] beside points with 1 mm of noise, and ``sag`` [m] more on its right."""
    (rest, faces), random = sheet(), np.random.default_rng(0)
    frames = 16
    clouds = random.uniform(0.02, 0.38, (frames * points, 3)) * [1, 1, 0]
    clouds += random.normal(0, 1e-3, clouds.shape)
    clouds[:, 2] -= np.where(clouds[:, 0] > 0.25, sag, 0.0)
    offsets = points * np.arange(frames + 1)
    model = np.tile(rest + np.array([0, 0, off]), (frames, 1, 1))
    rows = np.arange(frames)
    prediction = Prediction(rows, model, faces, False, rows % 4 + 1, rows // 4, np.ones(frames, bool))
    measurement = Measurement("m", 30.0, points=clouds, offsets=offsets, noise_mm=1.0)
    return compare(prediction, measurement, np.where(rest[:, 0] > 0.25, "right", "left"))


@pytest.mark.parametrize("off", [0.0, 0.6, 3.0])
def test_figures_of_clouds_are_of_their_points(off: float):
    """Distances of single points hold their noise, of which the floor tells as much."""
    figures = compared(1e-3 * off).figures
    error, floor = figures["error"], figures["floor"]
    median, far = foldnorm.ppf((0.5, 0.95), off)
    assert error["median_mm"] == pytest.approx(median, abs=0.03)
    assert error["p95_mm"] == pytest.approx(far, abs=0.05)
    assert error["median_mm"] == error["surface_median_mm"] == error["normal_median_mm"]
    assert error["interval_mm"][0] <= error["median_mm"] <= error["interval_mm"][1]
    assert floor["unexplained_mm"] == pytest.approx(max(median**2 - 0.6745**2, 0) ** 0.5, abs=0.15)
    parts = [*figures["by_region"], *figures["by_lag"], *figures["by_covariate"][0]["bins"]]
    assert [row["median_mm"] for row in parts] == pytest.approx([median] * len(parts), abs=0.08)
    assert figures["by_frame"]["median_mm"] == pytest.approx([median] * 16, abs=0.1)
    assert figures["moments"][0]["median_mm"] == pytest.approx(median, abs=0.15)
    for rows in (figures["by_region"], figures["by_lag"], figures["by_covariate"][0]["bins"]):
        assert sum(row["count"] for row in rows) == error["count"] == 32000


def test_a_point_counts_where_the_vertex_nearest_to_it_does():
    right, left = compared(0.0, sag=5e-3).figures["by_region"]
    assert (right["region"], left["region"]) == ("right", "left")
    assert right["median_mm"] == pytest.approx(foldnorm.median(5.0), abs=0.05)
    assert right["normal_mm"] == pytest.approx(5.0, abs=0.05)
    assert left["median_mm"] == pytest.approx(foldnorm.median(0.0), abs=0.05)


def test_the_map_of_a_cloud_shows_means():
    shown = compared(0.6e-3).errors
    assert shown.distance.shape == (16, 25)
    assert np.nanmedian(shown.distance) == pytest.approx(0.6e-3, abs=0.1e-3)


def test_of_dense_clouds_some_points_are_enough(monkeypatch):
    monkeypatch.setattr(metrics, "MOST", 500)
    error = compared(3e-3).figures["error"]
    assert error["count"] == 16 * 500
    assert error["median_mm"] == pytest.approx(foldnorm.median(3.0), abs=0.1)


def test_rows_without_points_count_nowhere():
    rest, faces = sheet()
    points = np.array([[0.1, 0.1, 0.002], [0.3, 0.3, 0.004], [0.2, 0.1, 0.006]])
    measurement = Measurement("m", 30.0, points=points, offsets=np.array([0, 2, 2, 3]))
    figures = compare(predicted(np.tile(rest, (3, 1, 1)), faces, False), measurement).figures
    assert figures["error"]["count"] == 3
    assert figures["by_frame"]["median_mm"] == [pytest.approx(3.0), None, pytest.approx(6.0)]


def noisy(frames: int = 24, **keys) -> tuple[Prediction, Measurement, np.ndarray]:
    """A right model that swings, restarted every four frames, and its vertices with noise (V,) of 0.3 or 5 mm [m]."""
    rest, faces = sheet()
    swing = 0.02 * np.sin(0.3 * np.arange(frames))[:, None, None] * np.array([1.0, 0, 0]) + rest
    sigma = np.where(np.arange(len(rest)) % 5 < 3, 3e-4, 5e-3)
    measured = swing + np.random.default_rng(0).normal(size=swing.shape) * sigma[:, None]
    rows = np.arange(frames)
    prediction = Prediction(rows, swing, faces, True, rows % 4 + 1, rows // 4, np.ones(frames, bool))
    return prediction, Measurement("m", 30.0, vertices=measured, faces=faces, noise=sigma, **keys), sigma


def test_noise_that_differs_explains_the_error_of_a_right_model():
    prediction, measurement, _ = noisy(400)
    figures = compare(prediction, measurement).figures
    error, floor = figures["error"], figures["floor"]
    assert floor["noise_median_mm"] == pytest.approx(error["median_mm"], rel=0.05)
    assert floor["explained_p95_mm"] == pytest.approx(error["p95_mm"], rel=0.05)
    assert [row["explained_mm"] for row in figures["by_region"]] == pytest.approx(
        [row["median_mm"] for row in figures["by_region"]], rel=0.15
    )


def test_noise_explains_by_what_was_seen_in_the_frames_compared():
    """Of vertices and frames that are not, and of points that lie across the cloth."""
    prediction, measurement, sigma = noisy(400)
    noise = np.tile(sigma, (400, 1))
    noise[300:] = 1.0
    seen = np.broadcast_to(sigma < 1e-3, noise.shape)
    fewer = replace(
        prediction,
        **{name: getattr(prediction, name)[:300] for name in ("frames", "vertices", "lag", "window", "converged")},
    )
    figures = compare(fewer, replace(measurement, noise=noise, visibility=seen)).figures
    assert figures["floor"]["noise_median_mm"] == pytest.approx(0.3 * 1.538172, rel=1e-3)
    flat, cloud = sheet()[0], np.random.default_rng(0).uniform(0.02, 0.38, (400 * 50, 3)) * [1, 1, 0]
    each = np.where(np.arange(len(cloud)) % 5 < 3, 3e-4, 5e-3)
    cloud[:, 2] = np.random.default_rng(1).normal(size=len(cloud)) * each
    points = Measurement("m", 30.0, points=cloud, offsets=50 * np.arange(401), noise=each)
    still = replace(prediction, vertices=np.tile(flat, (400, 1, 1)), registered=False)
    figures = compare(still, points).figures
    assert figures["floor"]["noise_median_mm"] == pytest.approx(figures["error"]["median_mm"], rel=0.05)


def test_noise_is_no_matter_of_speed():
    """Noisy vertices seem to move fast: their speed was taken for the cause of their error."""
    prediction, measurement, _ = noisy(48)
    found = {row["name"]: row for row in compare(prediction, measurement).figures["by_covariate"]}
    for name in ("speed", "acceleration"):
        assert abs(found[name]["contrast"]["difference_mm"]) < 1.0


def test_speed_and_acceleration_are_the_models_and_end_at_restarts():
    """x = 3 t^2 in every window, and a jump of a metre between them."""
    rest, faces = sheet()
    rows, time = np.arange(12), np.arange(12) % 6 / 30
    moved = rest + (3 * time**2 + np.arange(12) // 6)[:, None, None] * [1.0, 0, 0]
    prediction = Prediction(rows, moved, faces, True, rows % 6 + 1, rows // 6, np.ones(12, bool))
    found = {c.name: c.values for c in covariates(prediction, Measurement("m", 30.0, vertices=moved, faces=faces))}
    np.testing.assert_allclose(found["speed"], np.tile(6 * time[:, None], (1, len(rest))), atol=1e-6)
    np.testing.assert_allclose(found["acceleration"], 6.0, rtol=1e-6)
    free = replace(prediction, lag=None, frames=2 * rows[:6], vertices=moved[:6], window=rows[:6])
    seen = Measurement("m", 60.0, vertices=np.repeat(moved[:6], 2, axis=0), faces=faces)
    slow = {c.name: c.values for c in covariates(free, seen)}["speed"]  # every second frame, each a group of its own
    np.testing.assert_allclose(slow, np.tile(6 * time[:6, None], (1, len(rest))), atol=1e-6)


def test_what_was_never_measured_is_not_coloured():
    prediction, measurement, _ = noisy(visibility=np.broadcast_to(np.arange(25) != 7, (24, 25)))
    shown = track(compare(prediction, measurement)).fields["distance"]
    assert np.isnan(shown[:, 7]).all() and np.isfinite(np.delete(shown, 7, axis=1)).all()
