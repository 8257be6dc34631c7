"""A user's own effects, tried once before hours of work depend on them."""

from __future__ import annotations

from pathlib import Path

import torch

from caphy.effects.base import Step, companions
from caphy.effects.battery import gradient_is_slope, hessian_is_slope, linear_together, projection_is_semidefinite
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect, register_file
from caphy.effects.sources import reading
from caphy.effects.trial import DT, Moment, irregular_cloth, moment
from caphy.errors import CaphyError, EffectFailed


def use_file(path: Path) -> list[str]:
    """Register the effects of a user's file as :func:`caphy.effects.registry.register_file`, and try each of them on a
    small cloth, shaken and at rest; returns their names. What the file reads meanwhile counts as a part of it
    (:func:`caphy.effects.sources.sources`).

    Raises:
        CaphyError: one cannot be registered, fails, is not finite there (nor its Hessian), or has derivatives that are
            not its energy's.
    """
    with reading(path):
        names = register_file(path)
        for name in names:
            _try(name, path)
    return names


def _try(name: str, path: Path) -> None:
    effect, where = find_effect(name), f"{path}: {name}"
    advice = f"see caphy effects check --effect-file {path}"
    if "finite" in effect.lacks:  # it does nothing to this cloth
        _try_derivatives(name, where, advice)
        return
    cloth = irregular_cloth()
    at, rest = moment(cloth), torch.as_tensor(cloth.vertices)
    still = Step.implicit_euler(DT, rest, rest)
    try:
        potential = Potential(Model(cloth.density, {**{other: {} for other in companions(effect)}, name: {}}), cloth)
        told = {
            "shaken cloth": potential.gradient(at.x, at.step, at.body),
            "cloth at rest": potential.gradient(rest, still, at.body),
        }
    except EffectFailed:
        raise
    except CaphyError as error:
        raise CaphyError(f"{where}: {error}; {advice}") from error
    except Exception as error:
        raise CaphyError(f"{where} fails on a small cloth: {type(error).__name__}: {error}; {advice}") from error
    for what, parts in told.items():
        if not all(bool(part.isfinite().all()) for part in parts):
            raise CaphyError(f"{where} must have a finite energy and gradient, but has none on {what}; {advice}")
    for what, x, step in (("shaken cloth", at.x, at.step), ("cloth at rest", rest, still)):
        elements = next(each for other, _, each in potential.acting(x, step, at.body) if other == name)
        if not bool(effect.hessian(elements, potential.terms[name].values).isfinite().all()):
            raise CaphyError(
                f"{where} must have a finite Hessian, but has none on {what}; a power of what is zero there has none: "
                f"write (dot(v, v) + 1e-12) ** 1.25 for dot(v, v) ** 1.25; {advice}"
            )
    _try_derivatives(name, where, advice)
    _try_projection(potential, name, at, where, advice)


def _try_derivatives(name: str, where: str, advice: str) -> None:
    """What is fitted follows the gradient, and what it is called by the energy: they must be of one effect."""
    for check in (gradient_is_slope, hessian_is_slope):
        try:
            check(name)
        except CaphyError:
            raise
        except Exception as error:
            raise CaphyError(
                f"{where} must have a gradient and a Hessian, its own or those of a class that it inherits from, that "
                f"are the derivatives of its energy: {error}; {advice}"
            ) from error
    try:
        linear_together(name)  # or numbers, tables of tensile tests among them, would be of another physics
    except AssertionError as error:
        raise CaphyError(f"{where}: {error}; {advice}") from error


def _try_projection(potential: Potential, name: str, at: Moment, where: str, advice: str) -> None:
    """The solver adds projected Hessians to its matrix: they must be of the Hessian's shape, and lead downhill."""
    effect = find_effect(name)
    elements = next(each for other, _, each in potential.acting(at.x, at.step, at.body) if other == name)
    values = potential.terms[name].values
    wanted, got = (tuple(of(elements, values).shape) for of in (effect.hessian, effect.projected_hessian))
    if got != wanted:
        raise CaphyError(f"{where}: projected_hessian must have the shape of hessian, {wanted}, got {got}; {advice}")
    if "projection_is_semidefinite" in effect.lacks:
        return
    try:
        projection_is_semidefinite(name)
    except AssertionError as error:
        raise CaphyError(
            f"{where} must have a projected_hessian without negative eigenvalues that keeps what is stiff: {error}; "
            f"{advice}"
        ) from error
