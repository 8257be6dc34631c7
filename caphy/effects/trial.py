"""Small pieces of cloth, motions and bodies on which any effect can be tried."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import BodyState, Step
from caphy.effects.cloth import Cloth

DT = 1 / 30


def grid(columns: int, rows: int, width: float = 0.12, height: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """A flat grid in the xy plane: vertices (V, 3) [m] and faces (F, 3), all diagonals one way."""
    x, y = np.meshgrid(np.linspace(0, width, columns + 1), np.linspace(0, height, rows + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    right, up = corner + 1, corner + columns + 1
    return vertices, np.concatenate([np.stack([corner, right, up + 1], 1), np.stack([corner, up + 1, up], 1)])


def flat_cloth(columns: int = 6, rows: int = 5, width: float = 0.12, height: float = 0.1) -> Cloth:
    """A rectangle [m] of 0.2 kg/m^2, weft along x, held ever more strongly towards its top, 1 mm of layers."""
    vertices, faces = grid(columns, rows, width, height)
    thick = np.full(len(vertices), 0.001)
    return Cloth(vertices, faces, vertices[faces][..., :2], 0.2, thick, (vertices[:, 1] / height) ** 2)


def pleated_cloth() -> Cloth:
    """A flat rectangle whose template is folded, without any stretch, along lines of its grid."""
    flat = flat_cloth()
    slope = 0.6 * np.array([1, -1, 1, 1, -1, -1])
    width = flat.vertices[1, 0]
    line = np.concatenate([[(0, 0)], np.cumsum(width * np.stack([np.cos(slope), np.sin(slope)], 1), 0)])
    column = np.arange(len(flat.vertices)) % len(line)
    folded = np.stack([line[column, 0], flat.vertices[:, 1], line[column, 1]], 1)
    return Cloth(folded, flat.faces, flat.material, flat.density, flat.layer_thickness, flat.attached)


def irregular_cloth(seed: int = 0) -> Cloth:
    """An uneven mesh whose template is crumpled and whose thread frame turns from face to face."""
    random = np.random.default_rng(seed)
    vertices, faces = grid(6, 5)
    flat = vertices + random.uniform(-0.004, 0.004, vertices.shape) * (1, 1, 0)
    angle = random.uniform(-np.pi, np.pi, len(faces))[:, None]
    u, v = np.moveaxis(flat[faces][..., :2], -1, 0)
    material = np.stack([np.cos(angle) * u - np.sin(angle) * v, np.sin(angle) * u + np.cos(angle) * v], -1)
    strength = random.uniform(0, 1, len(flat)) * (random.uniform(size=len(flat)) < 0.5)
    template = flat + random.normal(0, 0.002, flat.shape)
    return Cloth(template, faces, material, 0.2, random.uniform(0, 0.003, len(flat)), strength)


@dataclass(frozen=True)
class Moment:
    """Positions with the step and the body of one or more frames."""

    x: Tensor
    step: Step
    body: BodyState

    def to(self, dtype: torch.dtype) -> Moment:
        """This moment in another precision."""
        return self.map(lambda field: field.to(dtype))

    def frame(self, index: int) -> Moment:
        """One frame of a batch."""
        return self.map(lambda field: field[index])

    def map(self, function: Callable[[Tensor], Tensor]) -> Moment:
        """This moment with a function applied to each of its vertex fields."""
        return Moment(function(self.x), self.step.map(function), self.body.map(function))


def moment(cloth: Cloth, frames: tuple[int, ...] = (), seed: int = 0, noise: float = 1.5e-3) -> Moment:
    """A shaken cloth on a body that moves beneath it at 0.5 m/s, in float64; about half of the vertices touch it."""
    generator = torch.Generator().manual_seed(seed)
    rest = torch.as_tensor(cloth.vertices, dtype=torch.float64)

    def random(scale: float) -> Tensor:
        return scale * torch.randn((*frames, *rest.shape), generator=generator, dtype=torch.float64)

    x, previous, before = (rest + random(noise) for _ in range(3))
    normal = torch.nn.functional.normalize(random(0.3) + torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64), dim=-1)
    velocity = random(0.5)
    point = previous + DT * velocity - normal * (0.004 + random(1e-3)[..., :1])
    body = BodyState(point, normal, velocity, rest + random(noise))
    return Moment(x, Step.implicit_euler(DT, previous, before, time=0.7), body)
