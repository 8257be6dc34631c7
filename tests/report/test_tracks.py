"""What the viewer of a page shows at first."""

from __future__ import annotations

import base64
import gzip
import re

import numpy as np
import pytest

from caphy.report.page import tracks
from caphy.report.page.compose import Section, comparison_page, diagnosis_page
from caphy.report.page.plots import bar_plot, lag_plot, time_plot
from caphy.report.page.tracks import Track, pack


def on_screen(scene: dict, points: np.ndarray) -> np.ndarray:
    """Where points (N, 3) [m] are on a square screen (N, 2); its border is at 1. As viewer.js has it."""
    focus = scene["focus"]
    a, e = focus["azimuth"], focus["elevation"]
    z = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    x = np.array([np.cos(a), 0, -np.sin(a)])
    away = points - (np.array(focus["centre"]) + focus["distance"] * z)
    return np.stack([away @ x, away @ np.cross(z, x)], 1) / (-away @ z)[:, None] / np.tan(focus["field"] / 2)


@pytest.mark.parametrize("size", [(0.4, 1.2, 0.01), (1.5, 0.3, 0.2), (0.3, 0.3, 2.0)])
def test_all_of_a_motion_is_seen(size):
    random = np.random.default_rng(0)
    vertices = random.uniform(-0.5, 0.5, (5, 40, 3)) * size + [3.0, 1.0, -2.0]
    scene = pack(Track(vertices, np.array([[0, 1, 2]]), np.arange(5), 30.0, {}))
    most = np.abs(on_screen(scene, vertices.reshape(-1, 3))).max()
    assert 0.85 < most < 1


def unpacked(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(gzip.decompress(base64.b64decode(text)), kind)


def test_errors_of_any_size_and_regions_of_any_number_are_as_they_are():
    """They ended at 327.67 mm, and region 256 was told as region 0."""
    vertices, names = np.random.default_rng(0).normal(size=(2, 300, 3)), np.array([f"r{i:03}" for i in range(300)])
    errors = np.linspace(-450, 900, 600).reshape(2, 300)
    scene = pack(Track(vertices, np.array([[0, 1, 2]]), np.arange(2), 30.0, {"distance": errors}, regions=names))
    shown = unpacked(scene["fields"]["distance"], "<i2").reshape(2, 300) * scene["stepMm"]
    assert np.abs(shown - errors).max() <= 0.51 * scene["stepMm"] and scene["stepMm"] < 0.03
    assert [scene["regionNames"][i] for i in unpacked(scene["regions"], "<u2")] == names.tolist()
    small = pack(Track(vertices, np.array([[0, 1, 2]]), np.arange(2), 30.0, {"distance": errors / 100}))
    assert small["stepMm"] == 0.01


def test_frames_are_told_by_their_numbers_in_the_source():
    """As the sentences do: of a film above 45 Hz every second one, of a folder from its first on."""
    track = Track(np.zeros((3, 3, 3)), np.array([[0, 1, 2]]), np.arange(3), 30.0, {}, numbering=(100, 2))
    assert pack(track)["numbering"] == [100, 2]
    plot = time_plot([0, 10, 20], {"median": [1.0, 2.0, 3.0]}, [0, 0, 0], None, (100, 2))
    assert 'data-first="0" data-last="20"' in plot  # where the viewer goes
    labels = [int(text) for text in re.findall(r">(\d+)<", plot)]
    assert 100 in labels and 140 in labels


def test_a_body_that_walks_is_seen_whole_in_every_frame():
    random = np.random.default_rng(0)
    body = random.uniform(-0.5, 0.5, (1, 60, 3)) * [0.6, 1.8, 0.4] + np.array([0, 0, 1.0]) * np.arange(4)[:, None, None]
    scene = pack(Track(body[:, :10], np.array([[0, 1, 2]]), np.arange(4), 30.0, {}, body=body))
    there = [np.abs(on_screen(scene, frame - frame.mean(0) + body[0].mean(0))).max() for frame in body]
    assert there == pytest.approx([there[0]] * 4)
    assert 0.85 < there[0] < 1


def filmed(frames: int, points: int) -> Track:
    """Clouds on a triangle; the row 78 is a worst moment."""
    random = np.random.default_rng(0)
    clouds = [random.uniform(size=(points, 3)) for _ in range(frames)]
    return Track(
        np.zeros((frames, 3, 3)), np.array([[0, 1, 2]]), np.arange(frames), 30.0, {}, measured=clouds, moments=[78]
    )


def test_points_are_left_out_before_frames():
    """Of 90 clouds of 60,000 points every fourth was shown, and nothing said so."""
    scene = pack(filmed(90, 60_000))
    assert scene["frames"] == list(range(90))
    assert np.diff(scene["measuredOffsets"]).tolist() == [5000] * 90
    assert "5000 of the up to 60000 points of a frame." in scene["leftOut"]
    assert pack(filmed(90, 5000))["leftOut"] == ""


def test_worst_moments_are_shown_however_many_frames_are_left_out(monkeypatch):
    monkeypatch.setattr(tracks, "BUDGET", 90 * 3_000)
    scene = pack(filmed(90, 2000))
    assert 78 in scene["frames"] and 77 not in scene["frames"] and 15 < scene["rows"] < 25
    assert f"holds {scene['rows']} of the 90 frames compared" in scene["leftOut"]
    assert len(unpacked(scene["model"], "<u2")) == scene["rows"] * 3 * 3


def test_frames_that_stand_alone_are_dots():
    """A path of nothing but moves draws nothing: every second frame missing, or restarts at every frame."""
    plot = time_plot([0, 2, 4, 5], {"median": [1.0, None, 3.0, 4.0]}, [0, 0, 1, 1], None)
    path, dots = re.findall(r'd="([^"]*)"', plot)
    assert dots == path[: path.index("h0") + 2]
    assert re.fullmatch(r"M[\d.]+ [\d.]+h0M[\d.]+ [\d.]+L[\d.]+ [\d.]+", path)
    alone = time_plot([0, 1], {"median": [1.0, 3.0]}, [0, 1], None)
    assert all(len(re.findall(r"M[\d.]+ [\d.]+h0", path)) == 2 for path in re.findall(r'd="([^"]*)"', alone))
    assert 'alone"' not in time_plot([0, 1], {"median": [1.0, 3.0]}, [0, 0], None)


@pytest.mark.parametrize("floor", [0.1, 5.0, 9.0, 12.0])
def test_what_is_explained_is_written_within_its_card(floor):
    plot = bar_plot("Error", [("hem", 10.0, 12.0)], floor)
    (x, anchor) = re.findall(r'class="floor" x="([\d.]+)" y="9" text-anchor="(\w+)"', plot)[0]
    left, right = (float(x), float(x) + 60) if anchor == "start" else (float(x) - 60, float(x))
    assert left > 0 and right < 420


def comparison(**measurement) -> dict:
    """The least figures that a page is made of."""
    row = {"median_mm": 1.0, "p95_mm": 2.0, "normal_mm": 0.0, "along_mm": 1.0, "down_mm": 0.0}
    about = {"name": "m", "frames": 4, "frames_seen": 4, "fps": 30.0, "registered": True, "holes": 0.0}
    directions = {"normal_median_mm": 1.0, "along_median_mm": 1.0, "down_mean_mm": 0.0}
    return {
        "measurement": about | {"notes": [], "remarks": []} | measurement,
        "prediction": {"restarted": False, "matched_vertices": True},
        "error": row | directions | {"surface_median_mm": 1.0, "chamfer_mm": 1.0},
        "floor": {
            **dict.fromkeys(["time_step_median_mm", "mesh_median_mm", "restart_median_mm"]),
            **dict.fromkeys(["noise_median_mm", "noise_sigma_mm", "explained_mm", "unexplained_mm"], 1.0),
            "noise_source": "stated",
        },
        "by_frame": {"frame": [0, 1], "median_mm": [1.0, 1.0], "p95_mm": [2.0, 2.0], "window": [0, 0]},
        "by_region": [row | {"region": "hem"}],
        "by_lag": [],
        "by_covariate": [],
        "sentences": ["It fits."],
    }


@pytest.mark.parametrize(
    ("holes", "says"), [(0.001, "0.1 % holes"), (0.0001, "less than 0.1 % holes"), (0.12, "12 % holes"), (0.0, None)]
)
def test_few_holes_are_not_none(holes, says):
    page = comparison_page("t", [Section(comparison(holes=holes))], {})
    assert ("holes<" in page) == (says is not None) and (says is None or f", {says}<" in page)


def test_a_page_says_what_is_doubted_of_a_measurement_and_what_the_view_lacks():
    figures = comparison(remarks=["m has edges up to 20 times as long as at rest"])
    page = comparison_page("t", [Section(figures, filmed(90, 6000))], {})
    assert "Note: m has edges up to 20 times as long as at rest." in page
    assert "the view holds 5000 of the up to 6000 points" in page
    assert "the view holds" not in comparison_page("t", [Section(figures, filmed(90, 60))], {})


def test_a_diagnosis_says_that_there_are_more_numbers_and_knows_no_minus_nothing():
    names = {f"wind.v{i}": 0.5 for i in range(5)}
    row = {"explanation": "wind", "family": "air", "gain": -1e-5, "gain_needed": 0.01, "wald": 1.0} | {
        "gain_after_refit": -1e-5,
        "first_estimate": names,
        "noticed_above": {"wind.v0": 0.1},
        "units": dict.fromkeys(names, "N"),
    }
    document = {
        "sentences": [],
        "held_out": None,
        "median_mm": {"before": 1.0, "after": 1.0, "noise": None},
        "base": None,
        "coefficients": {},
        "ranking": [row],
        "probes": {},
    }
    page = diagnosis_page("t", document, [], {})
    assert "-0.0" not in page and page.count("<td>0.0 %</td>") == 2
    assert "v0 0.5 N, v1 0.5 N, v2 0.5 N, ...</td>" in page and "0.1 N</td>" in page


def test_errors_after_a_restart_are_drawn_where_nothing_was_measured():
    rows = [{"lag": lag, "median_mm": None} for lag in (1, 2, 3)]
    assert 'class="dot"' not in lag_plot(rows, 0.5)
    assert lag_plot([*rows, {"lag": 4, "median_mm": 2.0}], None).count('class="dot"') == 1
