"""Curves of a model in tensile tests, quick enough to fit: a strip pulled one way and free to narrow.

Forces and energy of every effect are tabulated once over axial and transverse stretch and added up with the model's
values; the transverse stretch is where the sum of energies is least and that of forces balances. What is linear in a
coefficient is tabulated once per unit of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.integrate import cumulative_simpson

from caphy.effects.base import Parameter, Step, lending
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect
from caphy.measure.uniaxial import ModelCurve, square_cloth, transverse_stretches

NODES = 49
"""Axial strains at which curves are evaluated."""
TRANSVERSE = np.linspace(0.05, 1.5, 146)
"""Transverse stretches that are tabulated, beside those that are nearly as large as the axial one."""
_ROUNDS = 2
_SLOPES = np.linspace(-1.5, 0.5, 41)  # transverse over axial stretch along a path
_BEHIND = 1e-3  # of the stretch, where the last step of a slow loading began
RATE = 10.0
"""Of stretch [1/s] for what needs motion: so fast that dry friction does not fade, and nothing else may act."""

Table = np.ndarray
"""Force along and across per rest width [N/m], and the work per rest area that getting there across takes [J/m^2], but
for a constant at each axial stretch, at axial and transverse stretches (3, N, M)."""


@dataclass(eq=False)
class Strip:
    """A strip pulled along ``direction`` ("weft", "warp") to axial strains (N,)."""

    axial: np.ndarray
    direction: str
    side: float = 0.1
    rate: float = RATE
    transverse: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Stretches that are tabulated, (M,) or (N, M), rising; by default :data:`TRANSVERSE` and near the axial ones."""
    _tables: dict = field(default_factory=dict, repr=False)

    def curve(self, model: Model, names: tuple[str, ...]) -> ModelCurve:
        """What a model says of the strip; only the effects of these names count."""
        elastic = [name for name in names if not find_effect(name).needs_step]
        forces = sum((self.table(model, name) for name in elastic), np.zeros(self._shape))
        across, force = _balanced(forces, self.transverse)
        moving = [name for name in names if name not in elastic]
        slope = np.gradient(across, self.axial) if moving else across
        for _ in range(_ROUNDS if moving else 0):  # friction acts against the path, which bends when it acts
            whole = forces + sum(self._along_path(model, name, slope) for name in moving)
            across, force = _balanced(whole, self.transverse)
            slope = 0.5 * (slope + np.gradient(across, self.axial))
        return ModelCurve(self.axial, across - 1, force)

    def __post_init__(self) -> None:
        given = self.transverse if self.transverse.size else transverse_stretches(TRANSVERSE, 1 + self.axial)
        self.transverse = np.broadcast_to(given, (len(self.axial), given.shape[-1]))

    @property
    def _shape(self) -> tuple[int, int, int]:
        return 3, *self.transverse.shape

    def _along_path(self, model: Model, name: str, slope: np.ndarray) -> Table:
        """The table of an effect that needs motion on a path of slopes (N,), between tables of constant slopes."""
        place = np.clip((slope - _SLOPES[0]) / (_SLOPES[1] - _SLOPES[0]), 0, len(_SLOPES) - 1 - 1e-9)
        low = place.astype(int)
        total = np.zeros(self._shape)
        for k in np.unique([low, low + 1]):
            weight = np.where(low == k, 1 - place + low, np.where(low + 1 == k, place - low, 0.0))
            total += weight[:, None] * self.table(model, name, np.full(len(self.axial), _SLOPES[k]))
        return total

    def table(self, model: Model, name: str, slope: np.ndarray | None = None) -> Table:
        """The table of one effect; ``slope`` (N,): transverse over axial stretch along the path, for friction."""
        effect, values = find_effect(name), model.effects[name]
        linear = [effect.parameters[key].linear for key in effect.coefficients]
        if effect.borrows or lending(effect, model.effects) or not linear or not all(linear):
            return self._cached(model, name, slope)
        total = np.zeros(self._shape)
        off = {key: np.zeros_like(values[key]) for key in effect.coefficients}
        for key in effect.coefficients:
            for entry in np.ndindex(np.shape(values[key])):
                if values[key][entry]:
                    unit = np.zeros_like(values[key])
                    unit[entry] = _unit(effect.parameters[key])
                    one = Model(model.density, {name: {**values, **off, key: unit}})
                    total += values[key][entry] / unit[entry] * self._cached(one, name, slope)
        return total

    def _cached(self, model: Model, name: str, slope: np.ndarray | None) -> Table:
        effect = find_effect(name)
        needed = (name, *lending(effect, model.effects))
        values = [(n, k, np.asarray(v).tobytes()) for n in needed for k, v in sorted(model.effects[n].items())]
        key = (name, tuple(values), None if slope is None else slope.tobytes())
        if key not in self._tables:
            if len(self._tables) > 400:
                self._tables.pop(next(iter(self._tables)))
            self._tables[key] = self._evaluated(model, name, slope)
        return self._tables[key]

    def _evaluated(self, model: Model, name: str, slope: np.ndarray | None) -> Table:
        needed = (name, *lending(find_effect(name), model.effects))
        alone = Model(model.density, {n: model.effects[n] for n in needed})
        potential = Potential(alone, square_cloth(self.side, model.density))
        potential.terms = {name: potential.terms[name]}
        along, across = (torch.from_numpy(np.broadcast_to(s, self._shape[1:]).copy()) for s in self._stretches)
        x = self._positions(along, across)
        energy, gradient = potential.gradient(x, self._step(x, slope))
        # Positions are those at rest times the stretches
        weft, warp = (gradient[..., :2] * self._rest[:, :2]).sum(-2).movedim(-1, 0).numpy()
        along, across = (weft, warp) if self.direction == "weft" else (warp, weft)
        # Of elastic cloth the energy, which forces at nodes miss where it falls from one to the next at once; friction
        # has none that would belong to a place
        work = energy.numpy() if slope is None else cumulative_simpson(across, x=self.transverse, axis=1, initial=0)
        return np.stack([along, across, work]) / self.side**2

    @property
    def _rest(self) -> torch.Tensor:
        return torch.from_numpy(square_cloth(self.side, 1.0).vertices)

    @property
    def _stretches(self) -> tuple[np.ndarray, np.ndarray]:
        return 1 + self.axial[:, None], self.transverse

    def _positions(self, along: torch.Tensor, across: torch.Tensor) -> torch.Tensor:
        weft, warp = (along, across) if self.direction == "weft" else (across, along)
        return self._rest * torch.stack([weft, warp, torch.zeros_like(weft)], -1)[..., None, :]

    def _step(self, x: torch.Tensor, slope: np.ndarray | None) -> Step | None:
        """The last step of a slow loading: from slightly less stretch, along the path."""
        if slope is None:
            return None
        back = _BEHIND * np.stack([np.ones_like(slope), slope])[..., None]
        before = self._positions(
            *(
                torch.from_numpy(np.broadcast_to(s - b, self._shape[1:]).copy())
                for s, b in zip(self._stretches, back, strict=True)
            )
        )
        dt = _BEHIND / self.rate
        velocity = (x - before) / dt
        return Step(dt, before, before + dt * velocity, before, velocity)


def _unit(parameter: Parameter) -> float:
    """A value within the bounds with which the effect of a linear parameter is tabulated."""
    return min(1.0, parameter.upper) if parameter.upper > 0 else max(-1.0, parameter.lower)


def _balanced(table: Table, transverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transverse stretch (N,) of least work, and the force per width along there (N,).

    Between nodes the work is the cubic that has their values and their forces as slopes (Hermite), and the force along
    a parabola of three.
    """
    along, across, work = table
    rows, best = np.arange(len(work)), np.clip(work.argmin(1), 1, work.shape[1] - 2)
    found = [
        _least(*(each[rows, best + k] for k in (low, low + 1) for each in (transverse, work, across)))
        for low in (-1, 0)
    ]
    (below, deep), (above, deeper) = found
    at = np.where(deep < deeper, below, above)
    x, y, push = (np.stack([each[rows, best + k] for k in (-1, 0, 1)]) for each in (transverse, along, across))
    for _ in range(3):  # to where the forces balance: where they are steep, the force along goes by the last digits
        value, slope = _parabola(x, push, at)
        at = np.where(slope > 0, np.clip(at - value / np.where(slope > 0, slope, 1.0), x[0], x[2]), at)
    return at, _parabola(x, y, at)[0]


def _parabola(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value and slope at places (N,) of parabolas through three nodes (3, N)."""
    value, slope = np.zeros_like(at), np.zeros_like(at)
    for i, j, k in ((0, 1, 2), (1, 0, 2), (2, 0, 1)):
        weight = y[i] / ((x[i] - x[j]) * (x[i] - x[k]))
        value += weight * (at - x[j]) * (at - x[k])
        slope += weight * (2 * at - x[j] - x[k])
    return value, slope


def _least(
    x: np.ndarray, work: np.ndarray, slope: np.ndarray, x1: np.ndarray, work1: np.ndarray, slope1: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the cubic between two nodes is least, and its value there (N,)."""
    step, rise = x1 - x, work1 - work
    cubic, square = step * (slope + slope1) - 2 * rise, 3 * rise - step * (2 * slope + slope1)
    line = step * slope
    root = np.sqrt(np.maximum(square**2 - 3 * cubic * line, 0.0))
    inner = np.clip(-line / np.where(np.abs(square + root) > 1e-300, square + root, np.inf), 0.0, 1.0)
    places = np.stack([np.zeros_like(inner), inner, np.ones_like(inner)])
    values = work + places * (line + places * (square + places * cubic))
    least = values.argmin(0)
    rows = np.arange(len(inner))
    return x + step * places[least, rows], values[least, rows]
