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
from caphy.fabric.evidence import Said, by_force, by_response
from caphy.fabric.states import Layer
from caphy.fabric.stills import Worn

Objective = Literal["response", "force"]
"""Which least squares: the change of the equilibrium (the default), or CaPhy's squared gradient."""

FEWEST = 3
"""Scans that a fabric can be fitted to; intervals are of how much scans disagree."""
SETTLED = 0.02
"""Change of every table's stiffness in a round below which the rounds end."""

Guess = Callable[[Worn], np.ndarray]
"""Where the cloth may lie in a scan (V, 3) [m]: a network's answer, say."""
Progress = Callable[[int, int, int], None]
"""Told the round, the scans done in it and their total."""


@dataclass(frozen=True, eq=False)
class Round:
    """One outer round.

    Attributes:
        values: the numbers it started from (K,).
        said: what each scan said there.
        stiffness: each table's, over the start's, at the strains of the scans: effect -> ratio.
        median: of the points' distances from the cloth [m].
    """

    values: np.ndarray
    said: tuple[Said, ...]
    stiffness: dict[str, float]
    median: float


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fabric fitted to scans.

    Attributes:
        numbers: what was fitted, and from where.
        values: the numbers found (K,).
        rounds: oldest first; the last one's evidence stands at ``values`` or next to it.
        left_out: scans that could not be used, name -> why.
        settled: the last round changed next to nothing.
    """

    numbers: Coefficients
    values: np.ndarray
    rounds: tuple[Round, ...]
    left_out: dict[str, str] = field(default_factory=dict)
    settled: bool = False

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
        """Each table's stiffness over the start's at the strains of the scans, effect -> ratio."""
        return ratios(self.numbers, self.energy, self.values, self.numbers.values)


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


def fit_fabric(
    worn: Sequence[Worn],
    model: Model,
    rounds: int = 8,
    objective: Objective = "response",
    guess: Guess | None = None,
    progress: Progress | None = None,
) -> Fitted:
    """The fabric of a garment from scans of it at rest; the model's density and all else in it is kept.

    Args:
        worn: the same garment in each scan.
        model: where to start from.
        rounds: at most so many.
        guess: where to look for the cloth first; the skinned template unless given. It is followed from there.

    Raises:
        CaphyError: fewer than :data:`FEWEST` scans can be used, or the model has no fabric.
    """
    numbers = Coefficients.of(model)
    cloth = Cloth.of(worn[0].garment, model.density) if worn else None
    values, history, drawn = numbers.values, [], {}
    left_out: dict[str, str] = {}
    settled = False
    for number in range(rounds):
        assert cloth is not None or not worn
        said = _look(worn, numbers, values, cloth, objective, guess, drawn, left_out, number, progress)
        if len(said) < FEWEST:
            reasons = "".join(f"\n  {name}: {why}" for name, why in left_out.items())
            raise CaphyError(f"at least {FEWEST} scans are needed to fit a fabric, {len(said)} can be used{reasons}")
        energy = np.sum([one.energy for one in said], axis=0)
        median = float(np.median([one.median for one in said]))
        history.append(Round(values, said, ratios(numbers, energy, values, numbers.values), median))
        after = solve(Pooled.of(said), numbers, values)
        change = ratios(numbers, energy, after, values)
        values = after
        settled = all(abs(np.log(max(ratio, 1e-9))) < SETTLED for ratio in change.values())
        if settled:
            break
    return Fitted(numbers, values, tuple(history), left_out, settled)


def _look(
    worn: Sequence[Worn], numbers: Coefficients, values: np.ndarray, cloth: Cloth | None, objective: Objective,
    guess: Guess | None, drawn: dict[str, np.ndarray], left_out: dict[str, str], number: int, progress: Progress | None,
) -> tuple[Said, ...]:  # fmt: skip
    """What every scan says at some values; those that cannot be used are added to ``left_out``, with the reason."""
    if cloth is None:
        return ()
    model = numbers.model(values)
    layer, said = Layer(model, cloth), []
    for done, one in enumerate(worn):
        name = one.still.name
        if name in left_out:
            continue
        try:
            new = name not in drawn
            start = (one.skinned() if guess is None else guess(one)) if new else drawn[name]
            lying = layer.lie(one, start, seek=new)
            drawn[name] = lying.drawn
            found = (
                by_force(layer, one, lying, numbers, values)
                if objective == "force"
                else by_response(layer, one, lying, numbers)
            )
            if lying.rests and np.isfinite(found.b).all():
                said.append(found)
        except CaphyError as error:
            left_out[name] = str(error)
        if progress is not None:
            progress(number, done + 1, len(worn))
    return tuple(said)
