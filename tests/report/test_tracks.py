"""What the viewer of a page shows at first."""

from __future__ import annotations

import numpy as np
import pytest

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


def test_a_body_that_walks_is_seen_whole_in_every_frame():
    random = np.random.default_rng(0)
    body = random.uniform(-0.5, 0.5, (1, 60, 3)) * [0.6, 1.8, 0.4] + np.array([0, 0, 1.0]) * np.arange(4)[:, None, None]
    scene = pack(Track(body[:, :10], np.array([[0, 1, 2]]), np.arange(4), 30.0, {}, body=body))
    there = [np.abs(on_screen(scene, frame - frame.mean(0) + body[0].mean(0))).max() for frame in body]
    assert there == pytest.approx([there[0]] * 4)
    assert 0.85 < there[0] < 1
