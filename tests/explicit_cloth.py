"""Cloth on pins by an integrator of its own: explicit, tiny steps; shares no code with the solver."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from caphy.io.measurements import Measurement


def square(count: int = 9, side: float = 0.6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3) of a level square, faces (F, 3), flat coordinates (V, 2) [m]."""
    u, v = np.meshgrid(np.linspace(0, side, count), np.linspace(0, side, count))
    flat = np.stack([u.ravel(), v.ravel()], -1)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + count + 1, corner + count
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([a, d, c], -1)])
    vertices = np.stack([flat[:, 0] - side / 2, np.zeros(len(flat)), flat[:, 1]], -1)
    return vertices, faces, flat


def normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (T, V, 3) of a cloth at positions (T, V, 3), its faces weighted by area."""
    corner = positions[:, faces]
    area = np.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
    total = np.zeros_like(positions)
    for place in range(3):
        np.add.at(total, (slice(None), faces[:, place]), area)
    return total / np.linalg.norm(total, axis=-1, keepdims=True)


def clouds(positions: np.ndarray, faces: np.ndarray, count: int, noise: float, seed: int = 0) -> list[np.ndarray]:
    """Points (count, 3) [m] of each frame, spread over the faces anew in every frame."""
    random, found = np.random.default_rng(seed), []
    for x in positions:
        a, b, c = x[faces.T]
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        face = random.choice(len(faces), count, p=area / area.sum())
        u, v = np.sort(random.uniform(size=(2, count)), axis=0)
        points = u[:, None] * a[face] + (v - u)[:, None] * b[face] + (1 - v)[:, None] * c[face]
        found.append(points + random.normal(0, noise, points.shape))
    return found


def seen(frames: list[np.ndarray], keys: dict, **changes) -> Measurement:
    """Points of each frame as a measurement with a film's keys."""
    offsets = np.cumsum([0, *map(len, frames)])
    return Measurement(name="cloud", fps=30, points=np.concatenate(frames), offsets=offsets, **{**keys, **changes})


def simulate(
    seconds: float = 2.0,
    fps: float = 30.0,
    lame: tuple[float, float] = (20.9, 11.1),
    density: float = 0.2,
    drag: float = 0.0,
    count: int = 9,
    steps: int = 120,
    damping: float = 0.03,
    settle: float = 2.5,
    sway: float = 0.08,
    tempo: float = 1.0,
    push: Callable[[np.ndarray, np.ndarray, float], np.ndarray] | None = None,
) -> tuple[np.ndarray, dict]:
    """Positions (T, V, 3) of a square held by two corners that sway sideways, and the measurement's other keys.

    ``damping`` [N s/m] acts along edges. ``drag`` [kg/m^2/s] is a hidden force per area against the velocity, ``push``
    a hidden acceleration (V, 3) [m/s^2] of positions, velocities and the time [s]. The first ``settle`` seconds,
    damped, are left out.
    """
    rest, faces, flat = square(count)
    inverse = np.linalg.inv(
        np.stack([flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]]], -1)
    )
    area = 0.5 / np.abs(np.linalg.det(inverse))
    mass = np.bincount(faces.ravel(), np.repeat(area * density / 3, 3), len(rest))
    pinned = np.array([0, count - 1])
    x, v, dt, weight = rest.copy(), np.zeros_like(rest), 1 / (fps * steps), np.array([0.0, -9.81, 0.0])

    def pins(time: float) -> np.ndarray:
        t = max(time, 0.0)
        phase = 1 - np.exp(-((t / 0.2) ** 2))
        shift = np.array([sway * np.sin(5.0 * tempo * t), 0.0, 0.7 * sway * np.sin(3.0 * tempo * t)]) * phase
        return rest[pinned] + shift

    frames, total = [], round((settle + seconds) * fps)
    for frame in range(total + 1):
        time = frame / fps - settle
        if time >= -1e-9:
            frames.append(x.copy())
        for step in range(steps):
            now = time + step * dt
            push_now = 0.0 if push is None else push(x, v, now)
            slowed = drag / density + (3.0 if now < -0.5 else 0.0)  # settles down
            force = _forces(x, v, faces, inverse, area, lame, damping)
            v += dt * (force / mass[:, None] + weight + push_now - slowed * v)
            held, x = x[pinned], x + dt * v
            x[pinned] = pins(now + dt)
            v[pinned] = (x[pinned] - held) / dt
    positions = np.stack(frames)
    times = np.arange(len(positions)) / fps
    keys = {
        "faces": faces,
        "rest_vertices": rest,
        "material": flat[faces],
        "pinned": pinned,
        "pinned_positions": np.stack([pins(t) for t in times]),
    }
    return positions, keys


@njit(cache=True)
def _forces(x, v, faces, inverse, area, lame, damping):
    """Of StVK membranes, and a trace of damping along edges, so that the explicit scheme does not ring [N]."""
    lam, mu = lame
    force, f = np.zeros_like(x), np.empty((3, 2))
    for t in range(len(faces)):
        a, b, c = faces[t]
        (i, j), (k, m) = inverse[t, 0], inverse[t, 1]
        weft = warp = shear = 0.0
        for axis in range(3):
            one, two = x[b, axis] - x[a, axis], x[c, axis] - x[a, axis]
            p, q = one * i + two * k, one * j + two * m
            weft, warp, shear = weft + p * p / 2, warp + q * q / 2, shear + p * q / 2
            f[axis] = p, q
        weft, warp = weft - 0.5, warp - 0.5
        on_weft, on_warp, across = (
            lam * (weft + warp) + 2 * mu * weft,
            lam * (weft + warp) + 2 * mu * warp,
            2 * mu * shear,
        )
        for axis in range(3):
            p, q = f[axis]
            one, two = area[t] * (p * on_weft + q * across), area[t] * (p * across + q * on_warp)
            on_b, on_c = -(one * i + two * j), -(one * k + two * m)
            force[b, axis] += on_b
            force[c, axis] += on_c
            force[a, axis] -= on_b + on_c
        for p, q in ((a, b), (b, c), (c, a)):
            square = along = 0.0
            for axis in range(3):
                d = x[q, axis] - x[p, axis]
                square, along = square + d * d, along + (v[q, axis] - v[p, axis]) * d
            for axis in range(3):
                pull = damping * along / square * (x[q, axis] - x[p, axis])
                force[p, axis] += pull
                force[q, axis] -= pull
    return force


def measured(positions: np.ndarray, keys: dict, noise_mm: float = 1.0, seed: int = 0, **more) -> Measurement:
    """The positions as a measurement with independent noise on every coordinate."""
    noisy = positions + np.random.default_rng(seed).normal(0, 1e-3 * noise_mm, positions.shape)
    return Measurement(name="square", fps=30.0, vertices=noisy, **keys, **more)
