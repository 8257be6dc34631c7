"""Effects tried as additions to a model: switched off, so that they change nothing but show what they would do.

The derivative of the model's gradient by the coefficients of a candidate at zero says how the cloth would be pushed
by one unit of it:

    potential = Potential(with_candidates(model), cloth)
    columns = potential.parameter_gradients(x, step, body, coefficients(candidates(model)))
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from caphy.effects.model import Model
from caphy.effects.registry import find_effect, registered_effects


def candidates(model: Model, on_body: bool = True) -> tuple[str, ...]:
    """Names of all effects that can be added to a model; without those that need a body unless there is one."""
    return tuple(
        name
        for name in registered_effects()
        if name not in model.effects
        and (effect := find_effect(name)).coefficients
        and effect.lenders(model.effects) is not None
        and (on_body or not effect.needs_body)
    )


def switched_off(name: str) -> dict[str, np.ndarray]:
    """Parameters with which an effect exerts nothing: coefficients zero, everything else as by default."""
    effect = find_effect(name)
    defaults = {key: np.array(parameter.default, dtype=float) for key, parameter in effect.parameters.items()}
    return defaults | {key: np.zeros_like(defaults[key]) for key in effect.coefficients}


def with_candidates(model: Model, names: Iterable[str] | None = None) -> Model:
    """A model with effects added that are switched off; all possible ones unless names are given."""
    for name in candidates(model) if names is None else names:
        model = model.with_effect(name, **switched_off(name))
    return model


def coefficients(names: Iterable[str]) -> tuple[str, ...]:
    """Coefficients of effects as "effect.coefficient"."""
    return tuple(f"{name}.{key}" for name in names for key in find_effect(name).coefficients)
