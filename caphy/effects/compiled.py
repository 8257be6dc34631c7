"""Which effects have a compiled kernel, what it is called with, and running it on several threads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from caphy.effects import kernels
from caphy.effects.air import Air
from caphy.effects.air_drag_normal import AirDragNormal
from caphy.effects.air_drag_normal_quadratic import AirDragNormalQuadratic
from caphy.effects.air_drag_tangential import AirDragTangential
from caphy.effects.air_drag_tangential_quadratic import AirDragTangentialQuadratic
from caphy.effects.attachment import Attachment
from caphy.effects.base import BodyState, Effect, Step, Values
from caphy.effects.bending import Bending, bending_stiffness
from caphy.effects.bending_anisotropy import BendingAnisotropy, uneven_stiffness
from caphy.effects.bending_damping import BendingDamping, damping_stiffness
from caphy.effects.bending_measured import BendingMeasured, stiffness_nodes
from caphy.effects.body_contact import BodyContact
from caphy.effects.extra_bending import ExtraBending, extra_stiffness
from caphy.effects.gravity import Gravity
from caphy.effects.gust import Gust, swung
from caphy.effects.inertia import Inertia
from caphy.effects.strain_measured import StrainMeasured, directed
from caphy.effects.strain_stvk import StrainStVK
from caphy.effects.wind_normal import WindNormal
from caphy.effects.wind_normal_quadratic import WindNormalQuadratic
from caphy.effects.wind_tangential import WindTangential
from caphy.effects.wind_tangential_quadratic import WindTangentialQuadratic


@dataclass(frozen=True)
class Bound:
    """One effect on one cloth in one situation, as a kernel needs it."""

    index: Tensor
    rest: Mapping[str, Tensor]
    values: Values
    step: Step | None
    body: BodyState | None


Arguments = tuple[Callable, tuple[Tensor, ...], tuple[Tensor | float, ...]]
"""A kernel, the vertex fields (..., V, 3) it reads besides the positions, and its constants."""

DRAGS_AND_WINDS: tuple[type[Air], ...] = (
    AirDragNormal,
    AirDragNormalQuadratic,
    AirDragTangential,
    AirDragTangentialQuadratic,
    WindNormal,
    WindNormalQuadratic,
    WindTangential,
    WindTangentialQuadratic,
)
"""Effects of air by a uniform velocity or push of theirs, or none."""


def _strain_stvk(b: Bound) -> Arguments:
    lame = float(b.values["lame_lambda"]), float(b.values["lame_mu"])
    return kernels.strain_stvk, (), (b.index, b.rest["hat"], b.rest["area"], *lame)


def _strain_measured(b: Bound) -> Arguments:
    table = b.values["stretching"].to(torch.float64)
    return kernels.strain_measured, (), (b.index, b.rest["hat"], b.rest["area"], table[0], directed(table))


def _hinges(stiffness: Callable[[Mapping[str, Tensor], Values], Tensor], b: Bound) -> Arguments:
    rest = b.rest["angle"], b.rest["length"], b.rest["area"]
    return kernels.bending, (), (b.index, stiffness(b.rest, b.values), *rest)


def _bending_damping(b: Bound) -> Arguments | None:
    assert b.step is not None
    if isinstance(b.step.lead, Tensor):
        return None
    stiffness = damping_stiffness(b.rest, b.values, b.step.dt)
    constants = b.index, stiffness, b.rest["length"], b.rest["area"], float(b.step.lead)
    return kernels.bending_damping, (b.step.start, b.step.lagged), constants


def _bending_measured(b: Bound) -> Arguments:
    rest = b.rest["angle"], b.rest["length"], b.rest["area"]
    return kernels.bending_measured, (), (b.index, stiffness_nodes(b.rest, b.values), *rest)


def _inertia(b: Bound) -> Arguments:
    assert b.step is not None
    return kernels.spring, (b.step.target,), (b.index, b.rest["mass"] / b.step.dt**2)


def _attachment(b: Bound) -> Arguments:
    assert b.body is not None
    return kernels.spring, (b.body.anchor,), (b.index, b.values["stiffness"] * b.rest["strength"])


def _gravity(b: Bound) -> Arguments:
    return kernels.gravity, (), (b.index, b.rest["mass"], b.values["acceleration"])


def _body_contact(b: Bound) -> Arguments:
    assert b.body is not None
    constants = b.rest["area"], b.rest["layer"], float(b.values["stiffness"]), float(b.values["distance"])
    return kernels.body_contact, (b.body.point, b.body.normal), (b.index, *constants)


def _air(effect: type[Air], b: Bound, wind: Tensor | None = None, push: Tensor | None = None) -> Arguments:
    """An effect of air whose wind [m/s] and push [Pa] are the same everywhere."""
    assert b.step is not None
    drag = float(b.values["coefficient"]) if effect.power else 0.0
    fields = (
        torch.zeros(3, dtype=torch.float64) if field is None else field.to(torch.float64) for field in (wind, push)
    )
    constants = b.index, b.rest["area"], float(b.step.dt), effect.across, effect.power, drag, *fields
    return kernels.air, (b.step.origin, b.step.lagged), constants


def _wind(effect: type[Air], b: Bound) -> Arguments:
    return _air(effect, b, wind=b.values.get("velocity"), push=b.values.get("push"))


def _gust(b: Bound) -> Arguments | None:
    if b.step is None or isinstance(b.step.time, Tensor):
        return None  # frames of many times have many pushes
    return _air(Gust, b, push=swung(b.values, b.step.time))


KERNELS: Mapping[type[Effect], Callable[[Bound], Arguments | None]] = {
    StrainStVK: _strain_stvk,
    StrainMeasured: _strain_measured,
    Bending: partial(_hinges, bending_stiffness),
    ExtraBending: partial(_hinges, extra_stiffness),
    BendingAnisotropy: partial(_hinges, uneven_stiffness),
    BendingDamping: _bending_damping,
    BendingMeasured: _bending_measured,
    Gravity: _gravity,
    Inertia: _inertia,
    BodyContact: _body_contact,
    Attachment: _attachment,
    **{effect: partial(_wind, effect) for effect in DRAGS_AND_WINDS},
    Gust: _gust,
}
"""The effects that have a kernel, and what it is called with, or None where it does not hold;
:func:`caphy.effects.potential.kernel_of` asks whether it still is theirs."""


@dataclass(frozen=True)
class Loop:
    """A kernel with all that it reads but the positions, as arrays.

    Attributes:
        kernel: the compiled loop.
        fields: vertex fields (F, V, 3), a frame after another.
        constants: arrays and numbers, the same in all frames.
    """

    kernel: Callable
    fields: tuple[np.ndarray, ...]
    constants: tuple[np.ndarray | float, ...]

    @staticmethod
    def of(arguments: Arguments, x: Tensor) -> Loop:
        """What a kernel is called with at positions like x (..., V, 3)."""
        kernel, fields, constants = arguments
        fixed = (value.detach().contiguous().numpy() if isinstance(value, Tensor) else value for value in constants)
        return Loop(kernel, tuple(_frames(field, x) for field in fields), tuple(fixed))


@dataclass(frozen=True)
class Sums:
    """What kernels read and add to, as arrays made once for all effects.

    Attributes:
        x: positions (F, V, 3) [m], a frame after another.
        energy, gradient: sums (F,) [J] and (F, V, 3) [N].
    """

    x: np.ndarray
    energy: np.ndarray
    gradient: np.ndarray

    @staticmethod
    def of(x: Tensor, energy: Tensor, gradient: Tensor) -> Sums:
        """Of positions (..., V, 3), ``energy`` (...,) and ``gradient`` (..., V, 3), all contiguous, which are added
        to."""
        return Sums(_frames(x, x), energy.view(-1).numpy(), gradient.view(-1, *x.shape[-2:]).numpy())


def accumulate(loop: Loop, sums: Sums) -> None:
    """Add an effect."""
    if len(sums.x) == 1:
        loop.kernel(sums.x, *loop.fields, *loop.constants, sums.energy, sums.gradient)
        return
    moving, totals = (sums.x, *loop.fields), (sums.energy, sums.gradient)

    def run(part: slice) -> None:
        loop.kernel(*(field[part] for field in moving), *loop.constants, *(total[part] for total in totals))

    parts = _parts(len(sums.x))
    if len(parts) == 1:
        run(parts[0])
    else:
        list(_pool().map(run, parts))


def _frames(field: Tensor, x: Tensor) -> np.ndarray:
    """A vertex field as frames (F, V, 3) like those of x (..., V, 3)."""
    if field.shape != x.shape or field.dtype != x.dtype:
        field = field.to(x).expand_as(x)
    return field.detach().reshape(-1, *x.shape[-2:]).contiguous().numpy()


def _parts(count: int) -> list[slice]:
    """Frames split among as many threads as torch uses."""
    threads = max(1, min(torch.get_num_threads(), count))
    ends = [count * part // threads for part in range(threads + 1)]
    return [slice(start, end) for start, end in pairwise(ends)]


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix="caphy-effects")
