"""Physics models in tensile tests: force per width of a strip that is pulled and free to narrow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect
from caphy.io.measurements import ForceCurve
from caphy.measure.statistics import summary

_SIDE = 0.1  # of the square that is pulled [m]; effects whose stresses depend on it are left out
_TRIED = np.array([[1.0, 1.0], [1.1, 1.0], [1.0, 1.1], [1.2, 0.9], [0.9, 1.2]])  # stretches, the first at rest
_SAME = 1e-3  # share of an effect's work that its strip's size may decide
_STEP = 1e-5  # of the finite difference of the energy in stretch
_NARROW = np.linspace(0.05, 1.6, 156)  # transverse stretches that are tried before the search is refined
_ALIKE = np.linspace(-0.006, 0.006, 61)  # twice what the corners of measured tables are rounded over
_APART = 1e-9  # by which each stretch lies beyond the one before, though both may be meant to be the same
_REFINED = 40  # golden-section steps
MATTERS = 0.03  # of the force: errors that are said to be too stiff or too soft
STRAINS = 60
"""Strains at which a model's curve is evaluated."""


@dataclass(frozen=True, eq=False)
class ModelCurve:
    """What a model says of a strip.

    axial, transverse: engineering strains (N,); force: per rest width [N/m], (N,).
    """

    axial: np.ndarray
    transverse: np.ndarray
    force: np.ndarray


def model_curve(model: Model, axial: np.ndarray, direction: str) -> ModelCurve:
    """Force per width and transverse strain of a model at axial strains (N,), pulled along "weft" or "warp".

    The strip is uniform and free to narrow: the transverse stretch minimises the energy W, and by the envelope theorem
    the force per width is dW/d(axial stretch) per rest area at that minimum. What acts :func:`at_edges` is left out.
    """
    energy = _strip_energy(model, direction)
    stretch = 1 + np.asarray(axial, dtype=float)
    narrow = _narrowest(energy, stretch)
    return ModelCurve(np.asarray(axial, dtype=float), narrow - 1, _force(energy, stretch, narrow))


def held_tension(model: Model, axial: np.ndarray, direction: str) -> np.ndarray:
    """Force per width [N/m] at axial strains (N,) along "weft" or "warp" of a strip whose width is held.

    What acts :func:`at_edges`, in motion or on a body is left out.
    """
    return _force(_strip_energy(model, direction), 1 + np.asarray(axial, dtype=float), np.ones(len(axial)))


def _force(energy, stretch: np.ndarray, across: np.ndarray) -> np.ndarray:
    return (energy(stretch + _STEP, across) - energy(stretch - _STEP, across)) / (2 * _STEP)


def at_edges(model: Model) -> tuple[str, ...]:
    """Effects of a model that act at edges (seams, bands), or on a place, and not as a stress in the cloth.

    The work per area that stretches take of them depends on the size of the strip.
    """
    work = []
    for side in (_SIDE, 2 * _SIDE):
        potential = _in_square(model, side)
        energies = potential.energies(_stretched(potential.cloth, *_TRIED.T)).items()
        work.append({name: (energy[1:] - energy[0]).numpy() / side**2 for name, energy in energies})
    one, other = work
    return tuple(n for n in one if np.abs(one[n] - other[n]).max() > _SAME * np.abs(one[n]).max() + 1e-12)


def _in_square(model: Model, side: float) -> Potential:
    """A model without weight on a square."""
    if "gravity" in model.effects:  # not taken out: effects that have weight ask for it
        model = model.with_effect("gravity", acceleration=np.zeros(3))
    return Potential(model, square_cloth(side, model.density))


def _stretched(cloth: Cloth, weft: np.ndarray, warp: np.ndarray) -> torch.Tensor:
    """Positions (..., V, 3) [m] at stretches (...)."""
    scale = np.stack(np.broadcast_arrays(weft, warp, 0.0), -1)
    return torch.from_numpy(cloth.vertices * scale[..., None, :])


def _strip_energy(model: Model, direction: str):
    """Energy per rest area [J/m^2] of a square at axial and transverse stretches, (N,) each."""
    potential = _in_square(model, _SIDE)
    for name in at_edges(model):
        del potential.terms[name]

    def energy(axial: np.ndarray, transverse: np.ndarray) -> np.ndarray:
        weft, warp = (axial, transverse) if direction == "weft" else (transverse, axial)
        x = _stretched(potential.cloth, weft, warp)
        parts = potential.energies(x).values()
        return sum((part.numpy() for part in parts), np.zeros(x.shape[:-2])) / _SIDE**2

    return energy


def square_cloth(side: float, density: float) -> Cloth:
    """A square of two triangles, weft along x and warp along y, with sides of a length [m]."""
    flat = side * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    rest = np.column_stack([flat, np.zeros(4)])
    return Cloth(rest, faces, flat[faces], density, np.zeros(4), np.zeros(4))


def transverse_stretches(even: np.ndarray, axial: np.ndarray) -> np.ndarray:
    """Transverse stretches (N, M), rising, among which to look for the balance at axial stretches (N,): even ones, and
    those beside each axial one, where the energy of measured tables has wells narrower than the steps of those."""
    both = np.concatenate([np.broadcast_to(even, (len(axial), len(even))), axial[:, None] + _ALIKE], 1)
    return np.sort(both, 1) + _APART * np.arange(both.shape[1])


def _narrowest(energy, stretch: np.ndarray) -> np.ndarray:
    """Transverse stretches (N,) of least energy: the best of a table, refined by golden sections."""
    tried = transverse_stretches(_NARROW, stretch)
    best = np.clip(energy(stretch[:, None], tried).argmin(axis=1), 1, tried.shape[1] - 2)
    rows, ratio = np.arange(len(best)), (np.sqrt(5) - 1) / 2
    low, high = tried[rows, best - 1], tried[rows, best + 1]
    for _ in range(_REFINED):
        left, right = high - ratio * (high - low), low + ratio * (high - low)
        lower = energy(stretch, left) < energy(stretch, right)
        low, high = np.where(lower, low, left), np.where(lower, right, high)
    return 0.5 * (low + high)


def compare_curve(model: Model, curve: ForceCurve) -> dict:
    """Figures of one loading: errors of force at equal strain [N/m] and of transverse strain, by strain."""
    top = float(curve.axial.max())
    said = model_curve(model, np.linspace(0, max(top, 1e-3), STRAINS), curve.direction)
    force = np.interp(curve.axial, said.axial, said.force)
    across = np.interp(curve.axial, said.axial, said.transverse)
    error, loaded = force - curve.force, curve.axial > 0
    thirds = [
        (loaded) & (curve.axial > a * top) & (curve.axial <= b * top)
        for a, b in ((0, 1 / 3), (1 / 3, 2 / 3), (2 / 3, 1))
    ]
    strain_error = summary(1e-3 * np.abs(across - curve.transverse)[loaded])["median_mm"]
    return {
        "name": curve.name,
        "fabric": curve.fabric,
        "direction": curve.direction,
        "loading": curve.loading,
        "largest_strain": top,
        "largest_force_n_per_m": float(curve.force.max()),
        "rms_n_per_m": float(np.sqrt(np.mean(error[loaded] ** 2))),
        "relative_error": float(np.sqrt(np.mean(error[loaded] ** 2) / np.mean(curve.force[loaded] ** 2))),
        "mean_error_by_third_n_per_m": [float(error[part].mean()) if part.any() else None for part in thirds],
        "mean_force_by_third_n_per_m": [float(curve.force[part].mean()) if part.any() else None for part in thirds],
        "transverse_strain_error": strain_error,
        "model": {key: getattr(said, key).tolist() for key in ("axial", "transverse", "force")},
        "measured": _thinned(curve),
    }


def _thinned(curve: ForceCurve, count: int = 120) -> dict[str, list]:
    kept = np.unique(np.linspace(0, len(curve.axial) - 1, count).astype(int))
    transverse = [None if np.isnan(t) else float(t) for t in curve.transverse[kept]]
    return {"axial": curve.axial[kept].tolist(), "transverse": transverse, "force": curve.force[kept].tolist()}


def compare_curves(model: Model, curves: list[ForceCurve], name: str, source: str) -> dict:
    """Figures of all loadings in a table, ready for JSON."""
    rows = [compare_curve(model, curve) for curve in curves]
    said, left_out = curve_sentences(rows), at_edges(model)
    if left_out:
        listed = ", ".join(left_out)
        said.append(f"Left out of the model, because the strip's size decides what edges and places do: {listed}.")
    if moving := [name for name in model.effects if _of_strain_rates(name)]:
        said.append(
            f"Left out of the model, because a loading is compared as if each strain were held: {', '.join(moving)} "
            "(caphy diagnose and caphy refit count dry friction)."
        )
    return {"name": name, "source": source, "sentences": said, "curves": rows}


def _of_strain_rates(name: str) -> bool:
    """Whether an effect acts in cloth that is being strained, and not in cloth that is held."""
    effect = find_effect(name)
    return effect.needs_step and effect.element == "face" and not effect.needs_body and effect.group == "damping"


def curve_sentences(rows: list[dict]) -> list[str]:
    """What the curves of a table say of a model, only where the figures carry it."""
    relative = np.median([row["relative_error"] for row in rows])
    many = f"{len(rows)} loading{'s' * (len(rows) != 1)}"
    said = [f"The model's forces are {100 * relative:.0f} % off (median over {many}, rms over each)."]
    whole = [row for row in rows if None not in row["mean_error_by_third_n_per_m"]]
    low, high = ([_error_that_matters(row, third) for row in whole] for third in (0, 2))
    if low and np.mean(np.array(low) > 0) >= 0.8 and np.mean(np.array(high) < 0) >= 0.8:
        said.append("It is too stiff at small and too soft at large strains: the cloth stiffens, the model does not.")
    elif high and np.mean(np.array(high) > 0) >= 0.8:
        said.append(f"It is too stiff at large strains{_often(sum(each > 0 for each in high), len(high))}.")
    elif high and np.mean(np.array(high) < 0) >= 0.8:
        said.append(f"It is too soft at large strains{_often(sum(each < 0 for each in high), len(high))}.")
    return [*said, *_anisotropy(rows)]


def _often(some: int, count: int) -> str:
    if count == 1:
        return ""
    each = "both" if count == 2 else f"all {count}"
    return f" in {each if some == count else f'{some} of {count}'} loadings"


def _error_that_matters(row: dict, third: int) -> float:
    """The mean error [N/m] in a third of a loading's strains; none where it is small against the force there."""
    error, force = (row[f"mean_{what}_by_third_n_per_m"][third] for what in ("error", "force"))
    return error if abs(error) >= MATTERS * abs(force) else 0.0


def _anisotropy(rows: list[dict]) -> list[str]:
    """Fabrics whose strains at equal force differ between directions more than between loadings."""
    strains: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        force = 0.5 * min(r["largest_force_n_per_m"] for r in rows if r["fabric"] == row["fabric"])
        axial, pulled = (np.array(row["measured"][key]) for key in ("axial", "force"))
        rising = np.argsort(axial, kind="stable")  # whichever way the rows run
        strain = float(np.interp(force, np.maximum.accumulate(pulled[rising]), axial[rising]))
        strains.setdefault(row["fabric"], {}).setdefault(row["direction"], []).append(strain)
    both = {name: ways for name, ways in strains.items() if len(ways) == 2}
    apart = [
        name
        for name, ways in both.items()
        if min(ways["weft"]) > 1.1 * max(ways["warp"]) or min(ways["warp"]) > 1.1 * max(ways["weft"])
    ]
    if not apart:
        return []
    listed = ", ".join(name.replace("_", " ") for name in apart)
    if min(len(strains) for name in apart for strains in both[name].values()) < 2:  # repeats may differ as much
        return [f"Weft and warp differ in {len(apart)} of {len(both)} fabrics: {listed}."]
    return [f"Weft and warp differ by more than loadings do in {len(apart)} of {len(both)} fabrics: {listed}."]
