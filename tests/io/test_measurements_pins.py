"""Pins that are not where the pinned vertices were measured, and single frames that lie elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from test_measurements import swinging

from caphy.errors import CaphyError
from caphy.io.measurements import Measurement, read_measurement, write_measurement


def _pins(spoil: Callable[[np.ndarray], object], frames: int = 40) -> Measurement:
    """The sheet, its pins moved in a circle so that times can be told; the sheet goes with them."""
    sheet, angle = swinging(frames), 2 * np.pi * np.arange(frames) / 29
    way = 0.2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)[:, None]
    pins = (sheet.pinned_positions + way).astype(np.float64)
    told = spoil(pins)
    noise = np.random.default_rng(0).normal(0, 1e-3, sheet.vertices.shape)
    return replace(
        sheet, vertices=sheet.vertices + way + noise, pinned_positions=pins if told is None else told, noise_mm=1.0
    )


def _add(place: object, by: float) -> Callable[[np.ndarray], object]:
    def spoil(pins: np.ndarray) -> None:
        pins[place] += np.array([by, 0, 0])

    return spoil


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (_add(np.s_[:], 0.03), "the pinned vertices were measured 30 mm from pinned_positions; check"),
        (_add(np.s_[:, 1], 0.3), "vertex 0, number 1 of 'pinned', was measured 300 mm from its pinned_positions"),
        (
            _add(np.s_[7], 0.3),
            "in frame 7 the pinned vertices were measured 300 mm from pinned_positions",
        ),
        (lambda pins: np.roll(pins, 1, axis=0), "the pins are late by 1 frame: .* and 2 mm from those 1 later"),
        (lambda pins: np.roll(pins, -3, axis=0), "the pins are early by 3 frames: .* from those 3 earlier"),
    ],
)
def test_pins_lie_where_the_pinned_vertices_were_measured(tmp_path, spoil, says):
    write_measurement(_pins(lambda pins: None), tmp_path / "good.npz")
    read_measurement(tmp_path / "good.npz")
    write_measurement(_pins(spoil), tmp_path / "bad.npz")
    with pytest.raises(CaphyError, match=says):
        read_measurement(tmp_path / "bad.npz")


def test_a_clamp_is_as_thick_as_a_finger_and_unseen_vertices_say_nothing(tmp_path):
    thick = _pins(_add(np.s_[:], 0.015))
    vertices = thick.vertices.copy()
    vertices[5:9, thick.pinned[0]] = np.nan
    write_measurement(replace(thick, vertices=vertices), tmp_path / "m.npz")
    read_measurement(tmp_path / "m.npz")


@pytest.mark.parametrize("frame", [0, 1, 9, 18, 19])
@pytest.mark.parametrize(
    "spoil", [lambda x: x + np.array([0.3, 0, 0]), lambda x: 3 * x, lambda x: x[::-1]], ids=["place", "unit", "order"]
)
def test_a_single_frame_that_lies_elsewhere_is_told(tmp_path, frame, spoil):
    sheet = replace(swinging(), pinned=None, pinned_positions=None)
    vertices = sheet.vertices.copy()
    vertices[frame] = spoil(vertices[frame])
    write_measurement(replace(sheet, vertices=vertices), tmp_path / "m.npz")
    with pytest.raises(CaphyError, match=rf"frame {frame} lies elsewhere|in frame {frame} "):
        read_measurement(tmp_path / "m.npz")


def test_frames_far_apart_that_were_exchanged_are_told(tmp_path):
    """In a slow motion, where nothing is violent: 6 % of the cloth's size, at 65 m/s^2."""
    sheet, time = swinging(), np.arange(48) / 30
    sway = 0.04 * np.sin(2 * np.pi * 0.5 * time)
    vertices = np.repeat(sheet.rest_vertices[None], 48, axis=0) + sway[:, None, None] * np.array([1.0, 0, 0])
    vertices += np.random.default_rng(0).normal(0, 1e-3, vertices.shape)
    calm = replace(sheet, vertices=vertices, pinned=None, pinned_positions=None)
    write_measurement(calm, tmp_path / "calm.npz")
    read_measurement(tmp_path / "calm.npz")
    order = np.arange(48)
    order[[15, 27]] = [27, 15]
    write_measurement(replace(calm, vertices=vertices[order]), tmp_path / "exchanged.npz")
    with pytest.raises(CaphyError, match=r"frame (15|27) lies elsewhere than the frames around it say, by 0\.0"):
        read_measurement(tmp_path / "exchanged.npz")


def test_cloth_that_is_struck_is_believed(tmp_path):
    """It goes on from where it was struck."""
    sheet, frame = swinging(), np.arange(48)
    struck = 0.01 * np.maximum(frame - 20, 0)
    vertices = np.repeat(sheet.rest_vertices[None], 48, axis=0) + struck[:, None, None] * np.array([1.0, 0, 0])
    vertices += np.random.default_rng(0).normal(0, 1e-4, vertices.shape)
    write_measurement(replace(sheet, vertices=vertices, pinned=None, pinned_positions=None), tmp_path / "m.npz")
    read_measurement(tmp_path / "m.npz")


def test_what_is_written_where_nothing_was_seen_says_nothing(tmp_path):
    """Hidden vertices that a tracker guessed, and pins among them."""
    sheet = swinging()
    vertices, seen = sheet.vertices.copy(), np.ones(sheet.vertices.shape[:2], bool)
    seen[9, 6:] = seen[12, sheet.pinned] = False
    vertices[9, 6:] += np.array([0.5, 0, 0])
    vertices[12, sheet.pinned] += 0.4
    write_measurement(replace(sheet, vertices=vertices, visibility=seen), tmp_path / "m.npz")
    read_measurement(tmp_path / "m.npz")


def test_a_violent_motion_is_no_single_frame(tmp_path):
    """Ten swings a second through 6 cm: 120 m/s^2."""
    sheet = swinging(60)
    way = 0.03 * np.sin(2 * np.pi * 10 * np.arange(60) / 30 + 0.3)[:, None, None] * np.array([1.0, 0, 0])
    write_measurement(
        replace(sheet, vertices=sheet.vertices + way, pinned_positions=sheet.pinned_positions + way), tmp_path / "m.npz"
    )
    read_measurement(tmp_path / "m.npz")
