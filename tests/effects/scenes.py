"""Small pieces of cloth, motions and bodies on which effects are tested."""

from __future__ import annotations

import numpy as np

from caphy.effects.cloth import Cloth


def strip(nx: int, ny: int, width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """A flat grid in the xy plane: vertices (V, 3) [m] and faces (F, 3), diagonals all one way."""
    x, y = np.meshgrid(np.linspace(0, width, nx + 1), np.linspace(0, height, ny + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)).ravel()
    lower = np.stack([corner, corner + 1, corner + nx + 2], axis=1)
    upper = np.stack([corner, corner + nx + 2, corner + nx + 1], axis=1)
    return vertices, np.concatenate([lower, upper])


def flat_cloth(nx: int = 6, ny: int = 5, width: float = 0.12, height: float = 0.1, density: float = 0.2) -> Cloth:
    """A rectangle of cloth with the weft along x; its top row is attached, and every layer is 1 mm thick."""
    vertices, faces = strip(nx, ny, width, height)
    return Cloth(
        vertices,
        faces,
        vertices[faces][..., :2],
        density,
        np.full(len(vertices), 0.001),
        (vertices[:, 1] > height - 1e-9).astype(float),
    )


def crumpled_cloth(seed: int = 0) -> Cloth:
    """An irregular piece whose template is not flat and whose thread frame turns from face to face."""
    random = np.random.default_rng(seed)
    vertices, faces = strip(6, 5, 0.12, 0.1)
    flat = vertices + np.concatenate(
        [random.uniform(-0.004, 0.004, (len(vertices), 2)), np.zeros((len(vertices), 1))], 1
    )
    angle = random.uniform(-np.pi, np.pi, len(faces))
    turn = np.stack([np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([-np.sin(angle), np.cos(angle)], -1)], -1)
    material = np.einsum("fij,fcj->fci", turn, flat[faces][..., :2])
    template = flat + random.normal(0, 0.002, flat.shape)
    strength = random.uniform(0, 1, len(vertices)) * (random.uniform(size=len(vertices)) < 0.5)
    return Cloth(template, faces, material, 0.2, random.uniform(0, 0.003, len(vertices)), strength)
