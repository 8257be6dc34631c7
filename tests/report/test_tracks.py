"""What the viewer of a page shows at first."""

from __future__ import annotations

import base64
import gzip
import re

import numpy as np
import pytest

from caphy.report.page.plots import time_plot
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
