"""How sure the fitted numbers are: scans drawn again, and what the scans say beyond what was assumed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from caphy.fabric.bounded import Pooled, solve
from caphy.fabric.rounds import Fitted, over_first

REPLICAS = 200
LEVEL = 0.95
"""Of the intervals."""
DOUBTED = 2 / 3
"""Share of what taking off the mesh's error moved a table by that half an interval is at least: half as long edges
leave a third of it if it falls with their square, and hinges that lie otherwise as much again."""
WIDEST = 2.0
"""Upper over lower end of a table's interval from which on its stiffness counts as not determined."""


@dataclass(frozen=True, eq=False)
class Certainty:
    """What is known of a fitted fabric: of each table as a whole. Single entries make up for one another.

    Attributes:
        low, high: of each table's stiffness over the first model's own, effect -> end of the :data:`LEVEL` interval.
        determined: tables whose interval is narrow enough, effect -> whether.
    """

    low: dict[str, float]
    high: dict[str, float]
    determined: dict[str, bool]

    @classmethod
    def of(cls, fitted: Fitted, seed: int = 0) -> Certainty:
        """By bootstrap over the scans of the last round (Efron 1979), widened by Student's t for the few there are.

        What the mesh gets wrong all scans share: :data:`DOUBTED` of what taking it off moved a table by counts besides.
        Where a number lies at its bound, or a round is not long enough, an interval is too narrow; the rounds that led
        here are not drawn again.
        """
        random = np.random.default_rng(seed)
        numbers, last = fitted.numbers, fitted.rounds[-1]
        said, many, prior = last.said, len(last.said), fitted.prior or numbers
        noise = Pooled.of(said)
        logs = []
        for _ in range(REPLICAS):
            drawn = Pooled.of(said, np.bincount(random.integers(many, size=many), minlength=many).astype(float))
            values = solve(Pooled(drawn.a, drawn.b, noise.noise), prior, last.values)
            found = over_first(numbers, said, values)
            logs.append([np.log(max(found[name], 1e-12)) for name in numbers.names])
        spread = (
            np.std(logs, axis=0) * np.sqrt(many / max(many - 1, 1)) * student.ppf(0.5 + LEVEL / 2, max(many - 1, 1))
        )
        spread = np.hypot(spread, [DOUBTED * abs(_moved_by_mesh(fitted, name)) for name in numbers.names])
        middle = [np.log(max(fitted.stiffness[name], 1e-12)) for name in numbers.names]
        low = {name: float(np.exp(m - s)) for name, m, s in zip(numbers.names, middle, spread, strict=True)}
        high = {name: float(np.exp(m + s)) for name, m, s in zip(numbers.names, middle, spread, strict=True)}
        determined = {
            name: high[name] / low[name] < WIDEST and _moves(fitted, name) and fitted.settling(name)
            for name in numbers.names
        }
        return cls(low, high, determined)


def _moved_by_mesh(fitted: Fitted, name: str) -> float:
    """How far a table went, as a logarithm, since the error of the mesh was taken off for the first time."""
    before = next((one.stiffness[name] for one in fitted.rounds if one.corrected), fitted.stiffness[name])
    return float(np.log(max(fitted.stiffness[name], 1e-12) / max(before, 1e-12)))


def _moves(fitted: Fitted, name: str) -> bool:
    """Whether the scans say anything of a table at all: more than its loose prior does."""
    numbers = fitted.numbers
    mine = numbers.group == numbers.names.index(name)
    pooled = Pooled.of(fitted.rounds[-1].said)
    direction = np.where(mine, fitted.values, 0.0)
    count = len(direction)
    information = float(direction @ pooled.a[:count, :count] @ direction) / pooled.noise
    return information > 1.0
