"""The outer rounds: cloth laid into every scan under the present fabric, then the fabric that explains the scans."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.fabric.bounded import Pooled, solve
from caphy.fabric.coefficients import Coefficients
from caphy.fabric.evidence import Said, by_force, by_response, of_the_mesh
from caphy.fabric.states import Layer, Lying
from caphy.fabric.stills import Worn
from caphy.garment.subdivision import Subdivision
from caphy.kept import Kept

Objective = Literal["response", "force"]
"""Which least squares: the change of the equilibrium (the default), or CaPhy's squared gradient."""

FEWEST = 3
"""Scans that a fabric can be fitted to; intervals are of how much scans disagree."""
ROUNDS, CORRECTIONS = 12, 2
"""Rounds at most, and how often the mesh's error is told."""
BACK = 3
"""How often a round goes half-way back to the one before where cloth rests in too few scans under what it found."""
SETTLED = 0.01
"""Change of every table's stiffness in a round below which the rounds end."""
SETTLING = 0.1
"""Change in the last round from which on a table is not determined, whatever the scans agree on."""

Guess = Callable[[Worn], np.ndarray]
"""Where the cloth may lie in a scan (V, 3) [m]: a network's answer, say."""
Progress = Callable[[int, int, int], None]
"""Told the round, the scans done in it and their total."""


@dataclass(frozen=True, eq=False)
class Round:
    """One outer round.

    Attributes:
        corrected: whether the mesh's own error was taken off.
        values: the numbers it started from (K,).
        said: what each scan said there.
        stiffness: each table's, over the first model's own, at the strains of the scans: effect -> ratio.
        median: of the points' distances from the cloth [m].
    """

    values: np.ndarray
    said: tuple[Said, ...]
    stiffness: dict[str, float]
    median: float
    corrected: bool = False


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fabric fitted to scans.

    Attributes:
        numbers: what was fitted, and from where.
        values: the numbers found (K,).
        rounds: oldest first; the last one's evidence stands at ``values`` or next to it.
        left_out: scans that could not be used, name -> why.
        change: of each table's stiffness in the last round, effect -> ratio.
        prior: what the last rounds' numbers were held near, where that is not where ``numbers`` begin.
    """

    numbers: Coefficients
    values: np.ndarray
    rounds: tuple[Round, ...]
    left_out: dict[str, str] = field(default_factory=dict)
    change: dict[str, float] = field(default_factory=dict)
    prior: Coefficients | None = None

    @property
    def settled(self) -> bool:
        """Whether the last round changed next to nothing."""
        return _settled(self.change, SETTLED)

    def settling(self, name: str) -> bool:
        """Whether the last round changed a table so little that its interval means something."""
        return _settled({name: self.change.get(name, 1.0)}, SETTLING)

    @property
    def model(self) -> Model:
        """The physics with the fabric that was found."""
        return self.numbers.model(self.values)

    @property
    def energy(self) -> np.ndarray:
        """What each number is asked for in the scans (K,) [J per unit]."""
        return np.sum([one.energy for one in self.rounds[-1].said], axis=0)

    @property
    def stiffness(self) -> dict[str, float]:
        """Each table's stiffness over the first model's own at the strains of the scans, effect -> ratio."""
        return over_first(self.numbers, self.rounds[-1].said, self.values)


def ratios(numbers: Coefficients, energy: np.ndarray, values: np.ndarray, over: np.ndarray) -> dict[str, float]:
    """How much stiffer values (K,) are than others: energies at the same strains, effect -> ratio.

    A table has many entries and a scan strains the cloth in some ways only; where it does, this is the ratio of the
    energies that both tables store, the energy being linear in them.
    """
    found = {}
    for group, name in enumerate(numbers.names):
        mine = numbers.group == group
        found[name] = float(energy[mine] @ values[mine] / max(energy[mine] @ over[mine], 1e-300))
    return found


def over_first(numbers: Coefficients, said: Sequence[Said], values: np.ndarray) -> dict[str, float]:
    """What values (K,) store in the scans over what the first model's own tables do, effect -> ratio.

    Its energy is no sum over its entries: where those below zero make a stiffness negative, it counts as none.
    """
    energy = np.sum([one.energy for one in said], axis=0) * values
    first = np.sum([one.first for one in said], axis=0)
    return {
        name: float(energy[numbers.group == group].sum() / max(first[group], 1e-300))
        for group, name in enumerate(numbers.names)
    }


def fit_fabric(
    worn: Sequence[Worn],
    model: Model,
    rounds: int = ROUNDS,
    objective: Objective = "response",
    guess: Guess | None = None,
    progress: Progress | None = None,
    corrections: int = CORRECTIONS,
    kept: Kept | None = None,
    first: Model | None = None,
) -> Fitted:
    """The fabric of a garment from scans of it at rest; the model's density and all else in it is kept.

    Args:
        worn: the same garment in each scan.
        model: where to start from.
        rounds: at most so many.
        guess: where to look for the cloth first; the skinned template unless given. It is followed from there.
        corrections: times that the error of the mesh is told, where rounds settle or at equal shares of them; of the
            response only.
        kept: where cloth at rest is kept, and found again.
        first: whose tables the stiffness found is told over; ``model``'s unless given.

    Raises:
        CaphyError: fewer than :data:`FEWEST` scans can be used, or the model has no fabric.
    """
    numbers = Coefficients.of(model, first)
    scans = _Scans(tuple(worn), numbers, objective, guess, progress, kept)
    values, history = numbers.values, []
    left = corrections if objective == "response" else 0
    settled, change = False, {}
    for number in range(rounds):
        try:
            values, said = scans.tried(values, history[-1].values if history else None, number)
        except CaphyError:
            if not history:
                raise
            values, change = history[-1].values, dict.fromkeys(numbers.names, np.inf)  # nothing has settled
            break
        energy = np.sum([one.energy for one in said], axis=0)
        median = float(np.median([one.median for one in said]))
        history.append(Round(values, said, over_first(numbers, said, values), median, bool(scans.mesh)))
        after = solve(Pooled.of(said), numbers, values)
        change = ratios(numbers, energy, after, values)
        values = after
        settled = _settled(change, SETTLED)
        due = rounds * (corrections - left + 1) // (corrections + 1)
        if left and number < rounds - 1 and (settled or number + 1 >= due):
            scans.correct(values)
            left, settled = left - 1, False
        elif settled:
            break
    return Fitted(numbers, values, tuple(history), scans.left_out, change)


def _settled(change: dict[str, float], limit: float) -> bool:
    return all(abs(np.log(max(ratio, 1e-9))) < limit for ratio in change.values())


class _Scans:
    """The scans of one garment, and what is remembered of each from round to round."""

    def __init__(
        self, worn: tuple[Worn, ...], numbers: Coefficients, objective: Objective, guess: Guess | None,
        progress: Progress | None, kept: Kept | None = None,
    ) -> None:  # fmt: skip
        self.worn, self.numbers, self.objective, self.guess, self.progress = worn, numbers, objective, guess, progress
        self.kept = kept
        self.left_out: dict[str, str] = {}
        self.mesh: dict[str, np.ndarray] = {}  # what a finer mesh would change, by scan
        self._lying: dict[str, Lying] = {}

    def look(self, values: np.ndarray, number: int) -> tuple[Said, ...]:
        """What every scan says at some values; those that cannot be used are put into ``left_out``, with the reason."""
        said: list[Said] = []
        self._restless: dict[str, str] = {}
        if self.worn:
            cloth = Cloth.of(self.worn[0].garment, self.numbers.start.density)
            layer = Layer(self.numbers.model(values), cloth, self.kept)
            for done, one in enumerate(self.worn):
                if one.still.name not in self.left_out:
                    said += self._told(layer, one, values)
                if self.progress is not None:
                    self.progress(number, done + 1, len(self.worn))
        if len(said) < FEWEST:
            reasons = "".join(f"\n  {name}: {why}" for name, why in {**self._restless, **self.left_out}.items())
            raise CaphyError(f"at least {FEWEST} scans are needed to fit a fabric, {len(said)} can be used{reasons}")
        return tuple(said)

    def tried(self, values: np.ndarray, before: np.ndarray | None, number: int) -> tuple[np.ndarray, tuple[Said, ...]]:
        """Values (K,) and what the scans say there, or where that fails half-way back to ``before``, and so on."""
        if before is None:
            return values, self.look(values, number)
        left_out, lying = dict(self.left_out), dict(self._lying)
        for left in reversed(range(1 + BACK)):
            try:
                return values, self.look(values, number)
            except CaphyError:
                self.left_out, self._lying = dict(left_out), dict(lying)
                if not left:
                    raise
                values = np.sqrt(values * before)
        raise AssertionError("the last time returns or raises")

    def _told(self, layer: Layer, one: Worn, values: np.ndarray) -> list[Said]:
        """What a scan says; nothing where the cloth does not come to rest in it this time."""
        name = one.still.name
        try:
            before = self._lying.get(name)
            start = before.drawn if before is not None else one.skinned() if self.guess is None else self.guess(one)
            lying = self._lying[name] = layer.lie(one, start, seek=before is None)
            if self.objective == "force":
                found = by_force(layer, one, lying, self.numbers, values)
            else:
                found = by_response(layer, one, lying, self.numbers, self.mesh.get(name))
        except CaphyError as error:
            self.left_out[name] = str(error)
            return []
        if lying.rests and found.count and np.isfinite(found.b).all():
            return [found]
        self._restless[name] = f"the cloth did not come to rest ({lying.report.residual:.1g} N on the worst vertex)"
        return []

    def correct(self, values: np.ndarray) -> None:
        """Find what the mesh does: the cloth of each scan brought to rest with each face cut in four as well."""
        finer = Subdivision.of(self.worn[0].garment)
        density = self.numbers.start.density
        model = self.numbers.model(values)
        coarse = Layer(model, Cloth.of(self.worn[0].garment, density), self.kept)
        fine = Layer(model, Cloth.of(finer.garment, density), self.kept)
        for one in self.worn:
            name = one.still.name
            if name in self.left_out or name not in self._lying:
                continue
            try:
                lying = self._lying[name] = coarse.lie(one, self._lying[name].drawn, seek=False)
                worn = Worn(one.still, one.body, finer.garment)
                refined = fine.lie(worn, finer.carried(lying.drawn), seek=False)
            except CaphyError as error:
                self.left_out[name] = str(error)
                continue
            if lying.rests and refined.rests:
                self.mesh[name] = of_the_mesh(lying, refined, len(one.still.points))
