"""Flexible forces that belong to no effect: what a missing one depends on, where the library has no name for it.

Each probe is a small family of pressure fields on the cloth. They are fitted only after the library, never beside it: a
flexible field would take over what parameters explain (Brynjarsdottir, O'Hagan, Inverse Problems 30, 2014).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import BodyState, Step
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.vectors import cross
from caphy.refit.responses import Watched
from caphy.refit.tangents import Pushes

Fields = Callable[[Cloth, np.ndarray, Tensor, Step, BodyState | None], Tensor]
"""Pressures (K, ..., V, 3) [Pa] for a cloth with modes (V, M) at positions (..., V, 3) [m]."""

_PLACES = 9  # modes of the material that a force may follow
_NEAR = 0.03  # metres from the body that count as near
_BEATS = (0.5, 1.0, 2.0)  # swings per second

TO_AND_FRO = "place on the cloth and time"
"""The probe whose fields, with those of :data:`STEADY`, are polynomials in time; what swings is made of them."""
STEADY = "place on the cloth"
ORDER = 3
"""Of those polynomials: within a window of a quarter of a second they follow four swings a second."""


def _axes(scalar: Tensor) -> list[Tensor]:
    """A scalar field (..., V) along each world axis."""
    return [scalar[..., None] * axis for axis in torch.eye(3, dtype=scalar.dtype)]


def _places(modes: np.ndarray) -> Tensor:
    """The first modes (V, 9); zero where a cloth of few vertices has fewer, so that fields keep their places."""
    return torch.from_numpy(np.pad(modes, ((0, 0), (0, max(0, _PLACES - modes.shape[1]))))[:, :_PLACES])


def world_direction(cloth: Cloth, modes: np.ndarray, x: Tensor, step: Step, body: BodyState | None) -> Tensor:
    return torch.stack(_axes(torch.ones_like(x[..., 0])))


def velocity(cloth: Cloth, modes: np.ndarray, x: Tensor, step: Step, body: BodyState | None) -> Tensor:
    v = (x - step.origin) / step.dt
    return torch.stack([field for axis in range(3) for field in _axes(v[..., axis])])


def material_place(cloth: Cloth, modes: np.ndarray, x: Tensor, step: Step, body: BodyState | None) -> Tensor:
    places = _places(modes)
    return torch.stack([field for k in range(_PLACES) for field in _axes(places[:, k].expand(x.shape[:-1]))])


def material_place_in_time(cloth: Cloth, modes: np.ndarray, x: Tensor, step: Step, body: BodyState | None) -> Tensor:
    time = torch.as_tensor(step.time, dtype=x.dtype)[..., None]
    steady = material_place(cloth, modes, x, step, body)
    return torch.cat([time**power * steady for power in range(1, ORDER + 1)])


def place_in_space(cloth: Cloth, modes: np.ndarray, x: Tensor, step: Step, body: BodyState | None) -> Tensor:
    a, b, c = x.unbind(-1)
    powers = [torch.ones_like(a), a, b, c, a * a, b * b, c * c, a * b, b * c, c * a]
    return torch.stack([field for power in powers for field in _axes(power)])


def along_normal(cloth: Cloth, modes: np.ndarray, x: Tensor, step: Step, body: BodyState | None) -> Tensor:
    normal = vertex_normals(cloth, step.lagged)
    places = _places(modes)
    return torch.stack([places[:, k, None] * normal for k in range(_PLACES)])


def clock(cloth: Cloth, modes: np.ndarray, x: Tensor, step: Step, body: BodyState | None) -> Tensor:
    time = torch.as_tensor(step.time, dtype=x.dtype)
    waves = [wave(2 * np.pi * beat * time) for beat in _BEATS for wave in (torch.cos, torch.sin)]
    return torch.stack([field for wave in waves for field in _axes(wave.expand(x.shape[:-1]))])


def near_body(cloth: Cloth, modes: np.ndarray, x: Tensor, step: Step, body: BodyState | None) -> Tensor:
    if body is None:
        return torch.zeros((5, *x.shape), dtype=x.dtype)
    distance = ((x - body.point) * body.normal).sum(-1)
    nearness = torch.exp(-distance.clamp_min(0) / _NEAR)
    slip = (x - step.origin) / step.dt - body.velocity
    return torch.stack([nearness[..., None] * body.normal, nearness[..., None] * slip, *_axes(nearness)])


PROBES: dict[str, Fields] = {
    "world direction": world_direction,
    "velocity": velocity,
    STEADY: material_place,
    TO_AND_FRO: material_place_in_time,
    "place in space": place_in_space,
    "direction of the cloth's normal": along_normal,
    "time": clock,
    "nearness to the body": near_body,
}
"""What a force may depend on."""


def vertex_normals(cloth: Cloth, x: Tensor) -> Tensor:
    """Unit normals (..., V, 3) of positions (..., V, 3), weighted by area."""
    faces = torch.as_tensor(cloth.faces.astype(np.int64))
    a, b, c = (x[..., faces[:, k], :].movedim(-1, 0) for k in range(3))
    area = cross(b - a, c - a).movedim(0, -1)
    normal = torch.zeros_like(x)
    for k in range(3):
        normal.index_add_(-2, faces[:, k], area)
    return normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-12)


WIDTHS = {
    "world direction": 3,
    "velocity": 9,
    STEADY: 3 * _PLACES,
    TO_AND_FRO: 3 * _PLACES * ORDER,
    "place in space": 30,
    "direction of the cloth's normal": _PLACES,
    "time": 6 * len(_BEATS),
    "nearness to the body": 5,
}
"""How many fields each probe has."""


def probe_places(first: int = 0) -> dict[str, list[int]]:
    """Where each probe's fields are among all of them, the first being number ``first``."""
    places = {}
    for name, width in WIDTHS.items():
        places[name] = list(range(first, first + width))
        first += width
    return places


def probe_pushes(cloth: Cloth, modes: np.ndarray, x: Tensor, step: Step, body: BodyState | None) -> Tensor:
    """What one pascal of each field of each probe adds to the gradient of the potential (K, ..., V, 3) [N]."""
    area = torch.from_numpy(cloth.vertex_area)[:, None]
    return torch.cat([-area * fields(cloth, modes, x, step, body) for fields in PROBES.values()])


@dataclass(frozen=True, eq=False)
class Probes:
    """The flexible forces on each scene's cloth; other processes can be told of them."""

    model: Model

    def __call__(self, watched: Watched) -> Pushes:
        cloth, modes = watched.scene.potential(self.model).cloth, watched.projection.modes
        return lambda x, step, body: probe_pushes(cloth, modes, x, step, body)
