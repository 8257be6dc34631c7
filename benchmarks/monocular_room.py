"""A room to film in: planks, wallpaper, bricks, a door, a window and pictures, coloured by formulas."""

from __future__ import annotations

import numpy as np

HALF_WIDTH, HALF_DEPTH, HEIGHT = 8.0, 7.0, 3.0
"""The room is |x| < 8, |z| < 7 and 0 < y < 3 m."""

_OPENINGS = ((-3.9, -3.0, 0.0, 2.05, (0.36, 0.22, 0.13)), (1.2, 2.9, 0.95, 2.25, (0.72, 0.83, 0.92)))
"""Door and window of a wall: from and to along it, from and to above the floor [m], colour."""
_PICTURES = ((-1.6, -0.7, 1.25, 1.85, (0.55, 0.3, 0.25)), (0.0, 0.6, 1.3, 2.0, (0.25, 0.4, 0.32)))
_FRAME = 0.06


def room_picture(eye: np.ndarray, axes: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (N, 3) [sRGB, 0 to 1] and depths (N,) [m] seen from ``eye`` (3,) along camera directions ``rays``.

    Args:
        axes: rows are the camera's right, down and forward in the world, (3, 3).
        rays: directions in the camera with third component 1, (N, 3).
    """
    directions = rays @ axes
    bounds = np.array([[-HALF_WIDTH, 0.0, -HALF_DEPTH], [HALF_WIDTH, HEIGHT, HALF_DEPTH]])
    with np.errstate(divide="ignore"):
        reach = np.where(directions > 0, (bounds[1] - eye) / directions, (bounds[0] - eye) / directions)
    side = reach.argmin(axis=1)
    depth = reach[np.arange(len(reach)), side]
    points = eye + depth[:, None] * directions
    colours = np.empty((len(rays), 3))
    up = (side == 1) & (directions[:, 1] > 0)
    down = (side == 1) & ~up
    colours[up] = 0.9 - 0.04 * _noise(points[up, 0] / 0.7, points[up, 2] / 0.7)[:, None]
    colours[down] = _planks(points[down, 0], points[down, 2])
    for axis, along in ((0, 2), (2, 0)):
        on = side == axis
        wall = _bricks if axis == 0 else _wallpaper
        colours[on] = _furnished(points[on, along], points[on, 1], wall(points[on, along], points[on, 1]))
        colours[on] *= (0.8 + 0.2 * (directions[on, axis] > 0))[:, None]
    corner = np.minimum(HALF_WIDTH - abs(points[:, 0]), HALF_DEPTH - abs(points[:, 2]))
    return (colours * (0.82 + 0.18 * np.clip(corner, 0, 1))[:, None]).clip(0, 1), depth


def _planks(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    row = np.floor(x / 0.14)
    along = z + 0.73 * row % 1.9
    tone = _noise(row * 7.1, np.floor(along / 1.9) * 3.7)
    grain = _noise(x / 0.012, along / 0.35)
    gap = (x / 0.14 % 1 < 0.03) | (along / 1.9 % 1 < 0.003)
    shade = (0.75 + 0.2 * tone + 0.1 * grain) * np.where(gap, 0.55, 1.0)
    return shade[:, None] * np.array([0.62, 0.45, 0.30])


def _wallpaper(u: np.ndarray, y: np.ndarray) -> np.ndarray:
    stripe = np.where(u / 0.25 % 1 < 0.5, 1.0, 0.94)
    speckle = 1 - 0.05 * _noise(u / 0.02, y / 0.02)
    colour = (stripe * speckle)[:, None] * np.array([0.80, 0.78, 0.70])
    return np.where((y < 0.11)[:, None], 0.93, colour)


def _bricks(u: np.ndarray, y: np.ndarray) -> np.ndarray:
    row = np.floor(y / 0.09)
    along = u + 0.12 * (row % 2)
    mortar = (y / 0.09 % 1 < 0.12) | (along / 0.24 % 1 < 0.05)
    tone = 0.7 + 0.45 * _noise(np.floor(along / 0.24) * 5.3, row * 9.1)
    brick = (tone * (1 - 0.15 * _noise(u / 0.01, y / 0.01)))[:, None] * np.array([0.62, 0.36, 0.29])
    return np.where(mortar[:, None], 0.66, brick)


def _furnished(u: np.ndarray, y: np.ndarray, colours: np.ndarray) -> np.ndarray:
    for left, right, low, high, colour in (*_OPENINGS, *_PICTURES):
        inside = (u > left) & (u < right) & (y > low) & (y < high)
        edge = np.minimum(np.minimum(u - left, right - u), np.minimum(y - low, high - y))
        paint = np.asarray(colour) * (0.85 + 0.3 * _noise(u / 0.16, y / 0.16))[:, None]
        colours = np.where(inside[:, None], np.where((edge < _FRAME)[:, None], 0.95, paint), colours)
    return colours


def _noise(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Smooth noise (N,) in 0 to 1 with features of size one, the same at every call."""
    i, j = np.floor(u), np.floor(v)
    a, b = u - i, v - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    low = _hash(i, j) * (1 - a) + _hash(i + 1, j) * a
    high = _hash(i, j + 1) * (1 - a) + _hash(i + 1, j + 1) * a
    return low * (1 - b) + high * b


def _hash(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    return (np.sin(i * 127.1 + j * 311.7) * 43758.5453) % 1.0
