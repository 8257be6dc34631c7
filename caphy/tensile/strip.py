"""Curves of a model in tensile tests, quick enough to fit: a strip pulled one way and free to narrow.

Forces of every effect are tabulated once over axial and transverse stretch and added up with the model's values; the
transverse stretch is where the sum balances. What is linear in a coefficient is tabulated once per unit of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from caphy.effects.base import Parameter, Step, lending
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect
from caphy.measure.uniaxial import ModelCurve, square_cloth

NODES = 49
"""Axial strains at which curves are evaluated."""
TRANSVERSE = np.linspace(0.05, 1.5, 146)
"""Transverse stretches that are tabulated."""
_ROUNDS = 2
_SLOPES = np.linspace(-1.5, 0.5, 41)  # transverse over axial stretch along a path
_BEHIND = 1e-3  # of the stretch, where the last step of a slow loading began
RATE = 10.0
"""Of stretch [1/s] for what needs motion: so fast that dry friction does not fade, and nothing else may act."""

Table = np.ndarray
"""Force along and across per rest width [N/m] at axial and transverse stretches, (2, N, M)."""


@dataclass(eq=False)
class Strip:
    """A strip pulled along ``direction`` ("weft", "warp") to axial strains (N,)."""

    axial: np.ndarray
    direction: str
    side: float = 0.1
    rate: float = RATE
    transverse: np.ndarray = field(default_factory=lambda: TRANSVERSE)
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

    @property
    def _shape(self) -> tuple[int, int, int]:
        return 2, len(self.axial), len(self.transverse)

    def _along_path(self, model: Model, name: str, slope: np.ndarray) -> Table:
        """Forces of an effect that needs motion on a path of slopes (N,), between tables of constant slopes."""
        place = np.clip((slope - _SLOPES[0]) / (_SLOPES[1] - _SLOPES[0]), 0, len(_SLOPES) - 1 - 1e-9)
        low = place.astype(int)
        total = np.zeros(self._shape)
        for k in np.unique([low, low + 1]):
            weight = np.where(low == k, 1 - place + low, np.where(low + 1 == k, place - low, 0.0))
            total += weight[:, None] * self.table(model, name, np.full(len(self.axial), _SLOPES[k]))
        return total

    def table(self, model: Model, name: str, slope: np.ndarray | None = None) -> Table:
        """Forces of one effect; ``slope`` (N,): transverse over axial stretch along the path, for friction."""
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
        _, forces = potential.gradient(x, self._step(x, slope))
        # Positions are those at rest times the stretches
        weft, warp = (forces[..., :2] * self._rest[:, :2]).sum(-2).movedim(-1, 0).numpy()
        return np.stack([weft, warp] if self.direction == "weft" else [warp, weft]) / self.side**2

    @property
    def _rest(self) -> torch.Tensor:
        return torch.from_numpy(square_cloth(self.side, 1.0).vertices)

    @property
    def _stretches(self) -> tuple[np.ndarray, np.ndarray]:
        return 1 + self.axial[:, None], self.transverse[None]

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


def _balanced(forces: Table, transverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transverse stretch (N,) of least work and the force per width along there (N,), from parabolas of three nodes."""
    step = transverse[1] - transverse[0]
    along, across = forces
    work = np.cumsum(0.5 * step * (across[:, 1:] + across[:, :-1]), axis=1)
    best = np.clip(np.concatenate([np.zeros((len(work), 1)), work], 1).argmin(1), 1, len(transverse) - 2)
    rows = np.arange(len(best))
    below, here, above = (across[rows, best + k] for k in (-1, 0, 1))
    first, second = 0.5 * (above - below), above - 2 * here + below
    place = np.zeros(len(best))
    for _ in range(6):
        value, slope = here + place * (first + 0.5 * place * second), first + place * second
        place = np.clip(place - value / np.where(np.abs(slope) > 1e-12, slope, np.inf), -1, 1)
    low, middle, high = (along[rows, best + k] for k in (-1, 0, 1))
    force = middle + place * (0.5 * (high - low) + 0.5 * place * (high - 2 * middle + low))
    return transverse[best] + step * place, force
