"""Which effects the loadings have in common that a model lacks: forward selection on loadings that were left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from caphy.effects.registry import find_effect
from caphy.tensile.fit import Bench, Fit, fitted
from caphy.tensile.null import DRAWS, drawn, outside
from caphy.tensile.numbers import Number, added, changed

LEAST_GAIN = 0.03
"""Smallest share of the squared error of loadings left out that an effect must remove."""
_NEAR, _SHARE = 0.03, 0.9
_ALONE = 1e-3  # share of a number's response that no other explains, below which tests cannot tell it

Say = Callable[[str], None]
"""Told what is about to be fitted to which tests."""


@dataclass(frozen=True)
class Ranked:
    """One candidate against what is already in the model.

    Attributes:
        gain: share of the squared error of loadings left out that it removes, mean over fabrics.
        gains: the same by fabric.
        threshold: gain that the best of the library may reach by chance.
        used: it acts from the second loading on.
    """

    effect: str
    gain: float
    gains: dict[str, float]
    threshold: float
    used: bool = False
    count: int = 1

    @property
    def accepted(self) -> bool:
        return self.gain > max(self.threshold, LEAST_GAIN)


@dataclass(eq=False)
class Search:
    """The fits of all fabrics, each made once.

    Attributes:
        benches: tests of each fabric.
        base: the numbers of the model's own that are free.
        say: told of each fit.
    """

    benches: dict[str, Bench]
    base: tuple[Number, ...]
    say: Say | None = None
    _fits: dict[tuple[str, tuple[Number, ...]], Fit] = field(default_factory=dict, repr=False)

    def fit(self, fabric: str, extra: Sequence[Number] = ()) -> Fit:
        """The best fit of a fabric with further numbers; those of the base that these replace are held."""
        numbers = (*self.base, *extra)
        key = fabric, numbers
        if key not in self._fits:
            if self.say is not None:
                effects = dict.fromkeys(number.effect for number in extra)
                self.say(f"{', '.join(effects) or 'its own parameters'} on {fabric}")
            bench = self.benches[fabric]
            tried = [_extended(near, bench, self.base, tuple(extra)) for near in self._nearer(fabric, extra)]
            self._fits[key] = min(tried, key=lambda fit: fit.misfit) if extra else fitted(bench, numbers)
        return self._fits[key]

    def _nearer(self, fabric: str, extra: Sequence[Number]) -> list[Fit]:
        """Fits to start from, since wide strains have several minima: of the parameters alone, without the last effect,
        and the best so far with some of these numbers and no others."""
        if not extra:
            return []
        shorter = [number for number in extra if number.effect != extra[-1].effect]
        starts, allowed = [self.fit(fabric), self.fit(fabric, shorter)], {*self.base, *extra}
        some = [fit for (name, numbers), fit in self._fits.items() if name == fabric and set(numbers) < allowed]
        starts.append(min(some, key=lambda fit: fit.misfit))
        return list({id(fit): fit for fit in starts}.values())

    def fits(self, extra: Sequence[Number] = ()) -> dict[str, Fit]:
        return {fabric: self.fit(fabric, extra) for fabric in self.benches}

    def gains(self, old: Sequence[Number], new: Sequence[Number], fabrics: Sequence[str]) -> dict[str, float]:
        """Share of the squared error of loadings left out that new numbers remove beyond old ones, by fabric."""
        return {f: 1 - self.fit(f, new).foretold / max(self.fit(f, old).foretold, 1e-12) for f in fabrics}

    def chosen(
        self,
        candidates: Sequence[str],
        fabrics: Sequence[str],
        start: Sequence[str] = (),
    ) -> tuple[list[str], list[Ranked]]:
        """Names of effects that pass, in order, after those to start with; and the ranking of the first round."""
        names: list[str] = self.without_useless(start, fabrics)
        first: list[Ranked] = []
        for _ in candidates:
            if names and not any(outside(self.fit(f, numbers_of(names))) for f in fabrics):
                break
            ranking = self._ranking(names, [c for c in candidates if c not in names], fabrics)
            first = first or ranking
            best = _simplest(ranking)
            if best is None:
                break
            names.append(best.effect)
        return self.without_useless(names, fabrics), first

    def _ranking(self, names: Sequence[str], candidates: Sequence[str], fabrics: Sequence[str]) -> list[Ranked]:
        old = numbers_of(names)
        rows = [(candidate, self.gains(old, (*old, *added(candidate)), fabrics)) for candidate in candidates]
        threshold = self._threshold(old, candidates, fabrics)
        ranked = [
            Ranked(name, float(np.mean(list(gains.values()))), gains, threshold, count=len(added(name)))
            for name, gains in rows
        ]
        return sorted(ranked, key=lambda row: -row.gain)

    def _threshold(self, old: Sequence[Number], candidates: Sequence[str], fabrics: Sequence[str]) -> float:
        """What the largest gain stays below in 99 of 100 cases where loadings differ from the fit only by what repeats
        differ by; the fall is drawn, the error that it is a share of is the one there is."""
        if not candidates:
            return 0.0
        random = np.random.default_rng(0)
        draws = {f: np.stack([drawn(self.benches[f], random) for _ in range(DRAWS)]) for f in fabrics}
        before = np.stack([foretold(self.fit(f, old).slopes, draws[f]) for f in fabrics])
        there = np.array([max(self.fit(f, old).foretold, 1e-12) for f in fabrics])
        best = np.full(DRAWS, -np.inf)
        for candidate in candidates:
            new = (*old, *added(candidate))
            after = np.stack([foretold(self.fit(f, new).slopes, draws[f]) for f in fabrics])
            best = np.maximum(best, ((before - after) / there[:, None]).mean(0))
        return float(np.quantile(best, 0.99))

    def mean_gain(self, old: Sequence[Number], new: Sequence[Number], fabrics: Sequence[str]) -> float:
        """:meth:`gains`, mean over fabrics."""
        return float(np.mean(list(self.gains(old, new, fabrics).values())))

    def without_useless(self, names: Sequence[str], fabrics: Sequence[str]) -> list[str]:
        """Effects that are needed: those without which loadings left out are foretold as well go, weakest first."""
        kept = list(names)
        while kept:
            gain = {
                name: self.mean_gain(numbers_of([n for n in kept if n != name]), numbers_of(kept), fabrics)
                for name in kept
            }
            weakest = min(gain, key=lambda name: gain[name])
            if gain[weakest] > LEAST_GAIN:
                break
            kept.remove(weakest)
        return kept


def numbers_of(names: Sequence[str], used: bool = False) -> tuple[Number, ...]:
    """The coefficients of effects."""
    return tuple(number for name in names for number in added(name, used))


def _extended(near: Fit, bench: Bench, base: tuple[Number, ...], extra: tuple[Number, ...]) -> Fit:
    """The fit with further numbers, from a fit with fewer.

    Those of the model's own that the further ones can replace are held as they were given, since the tests cannot tell
    them from these (Lame's mu from weft and warp stiffness).
    """
    numbers, known = (*base, *extra), dict(zip(near.numbers, near.values, strict=True))
    start = np.array([known.get(number, number.start(near.bench.model)) for number in numbers])
    held = _replaced(bench.slopes(numbers, start).reshape(-1, len(numbers)), len(base))
    start[held] = [numbers[k].start(bench.model) for k in held]  # as they were given, not as a fit without had them
    kept = [k for k in range(len(numbers)) if k not in held]
    model = changed(bench.model, [numbers[k] for k in held], start[held])
    fits = (
        fitted(replace(bench, model=model), [numbers[k] for k in kept], s[kept]) for s in _starts(extra, numbers, start)
    )
    return min(fits, key=lambda fit: fit.misfit)


def _starts(extra: tuple[Number, ...], numbers: tuple[Number, ...], start: np.ndarray) -> list[np.ndarray]:
    """Where to begin (K,): the start itself, and with each new number that its effect is not linear in at each place
    where the effect looks for it."""
    found = [start]
    for number in extra:
        for place in find_effect(number.effect).further.get(number.parameter, ()):
            found.append(np.where([other == number for other in numbers], place, start))
    return found


def _replaced(slopes: np.ndarray, own: int) -> list[int]:
    """Which of the first ``own`` columns (n, K) the others explain, one after the other."""
    held: list[int] = []
    for k in reversed(range(own)):
        others = [j for j in range(slopes.shape[1]) if j != k and j not in held]
        left = slopes[:, k] - slopes[:, others] @ np.linalg.lstsq(slopes[:, others], slopes[:, k], rcond=1e-9)[0]
        if (left**2).sum() <= _ALONE * (slopes[:, k] ** 2).sum():
            held.append(k)
    return sorted(held)


def foretold(slopes: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Sum of squares (D,) of what linear fits leave of draws (D, L, 2, B) in each loading when it is left out."""
    count, k = len(slopes), slopes.shape[-1]
    flat, draws = slopes.reshape(count, -1, k), residual.reshape(len(residual), count, -1)
    scale = np.sqrt(np.maximum((flat**2).sum((0, 1)), 1e-300))
    flat = flat / scale
    normal, right = np.einsum("lik,lim->lkm", flat, flat), np.einsum("lik,dli->dlk", flat, draws)
    total = np.zeros(len(draws))
    for one in range(count):
        inverse = np.linalg.pinv(normal.sum(0) - normal[one], rcond=1e-10)
        values = (right.sum(1) - right[:, one]) @ inverse
        total += ((draws[:, one] - values @ flat[one].T) ** 2).sum(1)
    return total


def _simplest(ranking: Sequence[Ranked]) -> Ranked | None:
    """Of those that are about as good as the best, the one with the fewest coefficients; None if none passes."""
    best = ranking[0].gain if ranking else 0.0
    near = [row for row in ranking if row.accepted and row.gain >= min(best - _NEAR, _SHARE * best)]
    return min(near, key=lambda row: (row.count, -row.gain)) if near else None
