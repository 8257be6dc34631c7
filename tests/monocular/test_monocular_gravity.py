"""Which way is up, in pictures whose camera is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.clients.monocular.gravity import Gravity, up_from_lines

SIZE, FOCAL = (1280, 720), 1000.0
LEVEL_UP = np.array([0.0, -1.0, 0.0])


def _camera(pitch: float, roll: float) -> np.ndarray:
    """Rotation (3, 3) from a level camera's axes (right, down, ahead) to those of one pitched and rolled [deg]."""
    return Rotation.from_euler("zx", [roll, pitch], degrees=True).as_matrix()


def _picture(camera: np.ndarray, posts: int, seed: int = 0) -> np.ndarray:
    """Posts of a room, 2.4 m high, and as many lines in any direction."""
    random = np.random.default_rng(seed)
    picture = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    for i in range(2 * posts):
        start = np.array([random.uniform(-4, 4), 1.2, random.uniform(4, 8)])
        end = start - [0, 2.4, 0] if i < posts else start + random.normal(0, 1.0, 3)
        ends = np.stack([start, end]) @ camera.T
        if (ends[:, 2] > 0.5).all():
            points = np.rint(16 * (FOCAL * ends[:, :2] / ends[:, 2:] + np.array(SIZE) / 2)).astype(int).tolist()
            shade = int(random.integers(140, 250))
            cv2.line(picture, tuple(points[0]), tuple(points[1]), (shade,) * 3, 5, cv2.LINE_AA, 4)  # 16ths of pixels
    return picture


def _degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize(("pitch", "roll"), [(0, 0), (20, 0), (-15, 8), (25, -12)])
def test_posts_say_where_up_is(pitch: float, roll: float) -> None:
    camera = _camera(pitch, roll)
    found = up_from_lines(_picture(camera, 18), FOCAL, LEVEL_UP)
    assert found is not None
    assert _degrees(found, camera @ LEVEL_UP) < 1.0


def test_a_picture_without_lines_says_nothing() -> None:
    empty = np.full((720, 1280, 3), 128, np.uint8)
    assert up_from_lines(empty, FOCAL, LEVEL_UP) is None
    noise = np.random.default_rng(0).integers(0, 255, (720, 1280, 3)).astype(np.uint8)
    assert up_from_lines(cv2.GaussianBlur(noise, (0, 0), 3), FOCAL, LEVEL_UP) is None


def test_without_lines_people_stand_upright_in_the_mean() -> None:
    camera = _camera(18, 5)
    gravity, random = Gravity(FOCAL), np.random.default_rng(0)
    empty = np.full((72, 128, 3), 128, np.uint8)
    for t in range(60):
        lean = Rotation.from_rotvec(random.normal(0, 0.12, 3)).as_matrix()
        gravity.see(t / 30, empty, camera @ lean @ LEVEL_UP)
    assert not gravity.by_lines
    assert _degrees(gravity.turn[1], camera @ LEVEL_UP) < 3
    np.testing.assert_allclose(gravity.turn @ gravity.turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(gravity.turn) == pytest.approx(1)


def test_lines_are_preferred_and_kept_until_the_scene_changes() -> None:
    camera = _camera(20, 4)
    gravity = Gravity(FOCAL)
    gravity.see(0.0, _picture(camera, 18), None)
    assert gravity.by_lines
    first = gravity.turn
    for t in range(20):
        gravity.see(0.1 + t / 30, _picture(camera, 18), camera @ np.array([0.3, -0.95, 0.1]))
    np.testing.assert_array_equal(gravity.turn, first)
    gravity.forget()
    assert not gravity.by_lines


def test_a_few_upright_lines_among_many_others_say_nothing() -> None:
    """Nine posts agree, but most of what is near upright leans this way and that: grass, a floor seen askew, people."""
    random = np.random.default_rng(2)
    picture = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    for i in range(9):
        cv2.line(picture, (60 + 130 * i, 300), (60 + 130 * i, 420), (220,) * 3, 5, cv2.LINE_AA)
    alone = up_from_lines(picture, FOCAL, LEVEL_UP)
    assert alone is not None
    assert _degrees(alone, LEVEL_UP) < 2
    for i in range(96):
        lean = np.radians(random.choice([-1, 1]) * random.uniform(4, 24))
        x, y = 40 + 50 * (i % 24), (10, 80, 150, 500)[i // 24]
        end = int(x + 58 * np.sin(lean)), int(y + 58 * np.cos(lean))
        cv2.line(picture, (x, y), end, (170,) * 3, 5, cv2.LINE_AA)
    assert up_from_lines(picture, FOCAL, LEVEL_UP) is None


@pytest.mark.parametrize("seed", range(4))
def test_posts_side_by_side_leave_the_rest_to_the_standing_person(seed: int) -> None:
    """A door's edges say exactly how the camera is rolled, and little of how it is pitched; the person stands there."""
    camera, random = _camera(22, -3), np.random.default_rng(seed)
    picture = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    for x in np.linspace(-0.3, 0.3, 10):
        ends = np.array([[x, 0.4, 5.0], [x, -0.6, 5.0]]) @ camera.T
        places = FOCAL * ends[:, :2] / ends[:, 2:] + np.array(SIZE) / 2 + random.normal(0, 0.7, (2, 2))
        points = np.rint(16 * places).astype(int).tolist()
        cv2.line(picture, tuple(points[0]), tuple(points[1]), (210, 210, 210), 4, cv2.LINE_AA, 4)
    guess = _camera(24, -1) @ LEVEL_UP
    found = up_from_lines(picture, FOCAL, guess, np.radians(6))
    assert found is not None
    assert _degrees(found, camera @ LEVEL_UP) < 3


def test_the_first_picture_of_somebody_standing_says_where_up_is() -> None:
    """Not only after a while: a camera from above would be taken as level, and the world turned under the clothes."""
    camera = _camera(25, 3)
    gravity = Gravity(FOCAL)
    gravity.see(0.0, np.full((72, 128, 3), 128, np.uint8), camera @ LEVEL_UP)
    assert _degrees(gravity.turn[1], camera @ LEVEL_UP) < 6
    gravity.forget()
    gravity.see(0.0, np.full((72, 128, 3), 128, np.uint8), None)
    assert _degrees(gravity.turn[1], LEVEL_UP) < 1e-6
