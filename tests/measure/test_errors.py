"""Metrics against plain loops, closed forms and another package."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist
from scipy.stats import foldnorm

from caphy.io.measurements import Measurement
from caphy.measure import errors as metrics
from caphy.measure.comparison import Comparison, compare
from caphy.measure.errors import surface_errors, vertex_errors
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
