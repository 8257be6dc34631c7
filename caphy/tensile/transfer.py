"""What of a model carries over to a fabric that was never fitted: its structure, with one number for the stiffness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from caphy.effects.model import Model
from caphy.effects.registry import find_effect
from caphy.effects.units import dimensions
from caphy.tensile.errors import held_out_residual
from caphy.tensile.fit import Bench, Fit
from caphy.tensile.loadings import Tests, rows_of
from caphy.tensile.numbers import Number
from caphy.tensile.search import Search, numbers_of

_STRAIN = 0.1  # at which the stiffness of fabrics is compared
_STIFFNESS = dimensions("N/m")


def stiffness(bench: Bench) -> float:
    """Force per width and strain at 10 % [N/m], mean of the directions."""
    found = []
    for test in bench.tests:
        force = np.nanmean([loading.force for loading in test.loadings], axis=0)
        strain = np.nanmean([loading.strain for loading in test.loadings], axis=0)
        known = np.isfinite(force) & np.isfinite(strain)
        at = min(_STRAIN, float(strain[known].max()))
        found.append(float(np.interp(at, [0, *strain[known]], [0, *force[known]])) / at)
    return float(np.mean(found))


def shared_structure(fits: Mapping[str, Fit]) -> tuple[Model, Model]:
    """Models of the first loading and of used cloth whose numbers are the means of several fabrics', in units of each
    fabric's stiffness."""
    pairs = [(fit.models, stiffness(fit.bench)) for fit in fits.values()]
    return _mean([(m[0], s) for m, s in pairs]), _mean([(m[1], s) for m, s in pairs])


def _mean(models: Sequence[tuple[Model, float]]) -> Model:
    first = models[0][0]
    effects = {}
    for name in first.effects:
        declared = find_effect(name).parameters
        effects[name] = {
            key: np.mean([_scaled(m.effects[name][key], p.unit, 1 / s) for m, s in models], axis=0)
            for key, p in declared.items()
        }
    return _free(first.density, effects)


def _scaled(value: np.ndarray, unit: str, factor: float) -> np.ndarray:
    return np.asarray(value) * (factor if dimensions(unit) == _STIFFNESS else 1.0)


def _free(density: float, effects: dict) -> Model:
    for name, values in effects.items():
        for key, value in values.items():
            declared = find_effect(name).parameters[key]
            values[key] = np.clip(value, declared.lower, declared.upper)
    return Model(density, effects)


def transferred(bench: Bench, structure: tuple[Model, Model]) -> tuple[np.ndarray, float]:
    """Residual (L, 2, B) over the scatter of a fabric under a structure learned elsewhere, and its stiffness [N/m]: the
    one number that is fitted, to the first repeat of its first direction."""
    rows = rows_of(bench.tests)
    learning = next((i for i, (_, loading) in enumerate(rows) if loading.used), 0)
    scale = stiffness(bench)
    for _ in range(3):  # nearly linear: only what has a stiffness of its own to fade with is not
        residual = _residual(bench, structure, scale)
        test, loading = rows[learning]
        measured = np.nan_to_num(loading.force / test.scatter[0])
        said = measured - residual[learning, 0]
        scale *= float(said @ measured / max(said @ said, 1e-300))
    return _residual(bench, structure, scale), scale


def few_shot(
    bench: Bench, base: tuple[Number, ...], names: Sequence[str], held: tuple[tuple[Number, float], ...]
) -> tuple[list[Tests], dict[str, np.ndarray]]:
    """Effects named on other fabrics, their numbers fitted to one repeat of each direction of a new one.

    What used cloth has comes from the other fabrics (``held``).

    Returns:
        all its other loadings, and their residuals (L, 2, B) with its parameters and with the effects; none where
        there is but one of each direction.
    """
    learning, rest = [], []
    for test in bench.tests:
        one = next((x for x in test.loadings if x.used), test.loadings[0])
        learning.append(replace(test, loadings=(one,)))
        others = tuple(x for x in test.loadings if x is not one)
        rest += [replace(test, loadings=others)] if others else []
    if not rest:
        return [], {}
    plain = Search({"": replace(bench, tests=learning, held=())}, base).fit("")
    named = Search({"": replace(bench, tests=learning, held=held)}, base).fit("", numbers_of(names))
    stages = {"parameters": plain, "with effects": named}
    return rest, {stage: held_out_residual(fit, rest) for stage, fit in stages.items()}


def _residual(bench: Bench, structure: tuple[Model, Model], scale: float) -> np.ndarray:
    models = [_mean([(model, 1 / scale)]) for model in structure]
    return bench.residual(bench.curves_of(*models))
