"""What a force curve must be before anything is concluded from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from caphy.errors import CaphyError
from caphy.io.measurements import ForceCurve
from caphy.io.measurements.force_curves import UNLOADED

_LEAST_ROWS = 8
_PRELOAD = 0.01  # share of its largest force at which a loading may begin
_SHUFFLED = 0.2  # mean step between rows over the whole range; 1/3 when rows are in random order
_SLACK = 0.9  # share of its largest strain from which on a loading's first row is its last
_AGREE = 0.6  # rank correlation of force and strain
_NOISE = 0.6  # scatter between repeats over the force


def usable(curves: Sequence[ForceCurve]) -> tuple[list[ForceCurve], list[str]]:
    """Loading branches fit for a diagnosis, and sentences on what was left out; raises :class:`CaphyError`."""
    if not curves:
        raise CaphyError("there are no force curves: a tensile table needs a header and rows; see docs/measurements.md")
    checked = [_checked(curve) for curve in curves]
    cautions, kept = unloading(curves, checked), []
    for curve in checked:
        start = float(curve.force[:3].min())
        if start > _PRELOAD * curve.force.max():
            cautions.append(
                f"{_where(curve)} begins under {start:.0f} N/m, so its length at no load is unknown; it is left out."
            )
        else:
            kept.append(curve)
    if not kept:
        raise CaphyError(
            f"{_where(checked[0])}: every loading begins under load, so strains are not counted from the length at no "
            "load; start each loading slack, or give strains from the unloaded length"
        )
    _check_duplicates(kept)
    _check_noise(kept)
    cautions += far_stretched(kept)
    widening = [curve.name for curve in kept if curve.transverse[-1] > 0.1]
    if widening:
        cautions.append(f"{widening[0]} gets wider as it is pulled: check the sign of the transverse strain.")
    return kept, cautions


def require_tension(curve: ForceCurve) -> None:
    """Raises :class:`CaphyError` where signs or units cannot be those of cloth that is pulled."""
    where, top = _where(curve), float(curve.force.max())
    if top <= 0 or -curve.force.min() > 0.2 * top:
        raise CaphyError(
            f"{where}: forces must be positive in tension, got {curve.force.min():.3g} to {top:.3g} N/m; change the "
            "sign or subtract the load cell's zero"
        )
    if curve.axial.max() < 1e-3 or -curve.axial.min() > 0.2 * curve.axial.max():
        raise CaphyError(
            f"{where}: strains must grow from zero as the strip is pulled, got {curve.axial.min():.3g} to "
            f"{curve.axial.max():.3g}; a strain is length over rest length, less one"
        )
    if top < UNLOADED or not 1e-1 <= top / curve.axial.max() <= 1e6:
        raise CaphyError(
            f"{where}: {top:.3g} N/m at a strain of {curve.axial.max():.3g} is no cloth; forces must be in newton per "
            "metre of width at rest (N over the strip's width in m; kN/m times 1000), strains fractions"
        )


def far_stretched(curves: Sequence[ForceCurve]) -> list[str]:
    """What was read, in a sentence, where a strip is pulled to twice its length: knits may be, or it is percent."""
    longest = max(curves, key=lambda curve: curve.axial.max())
    if longest.axial.max() <= 1:
        return []
    return [
        f"{_where(longest)}: the largest strain read is {100 * longest.axial.max():.0f} %; if the column is in "
        "percent, divide it by 100."
    ]


def _checked(curve: ForceCurve) -> ForceCurve:
    where = _where(curve)
    if len(curve.axial) < _LEAST_ROWS:
        raise CaphyError(f"{where}: needs at least {_LEAST_ROWS} rows, got {len(curve.axial)}; sample more often")
    require_tension(curve)
    span = np.ptp(curve.axial)
    if np.abs(np.diff(curve.axial)).mean() > _SHUFFLED * span and len(curve.axial) > 2 * _LEAST_ROWS:
        raise CaphyError(f"{where}: rows look shuffled: the strain jumps from row to row; sort them by time")
    if curve.axial[0] > _SLACK * curve.axial.max():
        raise CaphyError(
            f"{where}: rows must begin slack, but the first has a strain of {curve.axial[0]:.3g} of at most "
            f"{curve.axial.max():.3g}; do they run downwards? Sort them by rising strain"
        )
    curve = loading_branch(curve)
    if len(curve.axial) < _LEAST_ROWS:
        raise CaphyError(
            f"{where}: needs at least {_LEAST_ROWS} rows up to its largest strain, got {len(curve.axial)}; what "
            "follows is unloading. Sample more often"
        )
    agreement = _rank_correlation(curve.axial, curve.force)
    if agreement < _AGREE:
        raise CaphyError(
            f"{where}: force must rise with strain, but their rank correlation is {agreement:.2f}; are columns "
            "exchanged, or rows of several loadings mixed?"
        )
    return curve


def loading_branch(curve: ForceCurve) -> ForceCurve:
    """Rows up to the largest strain: what follows is unloading. Those that run downwards are left as they are."""
    if curve.axial[0] > _SLACK * curve.axial.max():
        return curve
    end = int(curve.axial.argmax()) + 1
    return replace(curve, axial=curve.axial[:end], transverse=curve.transverse[:end], force=curve.force[:end])


def unloading(given: Sequence[ForceCurve], checked: Sequence[ForceCurve]) -> list[str]:
    """What is said where rows were left out."""
    cut = [old for old, new in zip(given, checked, strict=True) if len(new.axial) < len(old.axial)]
    if not cut:
        return []
    return [
        f"{_where(cut[0])} is let go after its largest strain, as are {len(cut)} of {len(given)} loadings: rows of "
        "unloading are left out, so that nothing is said of what they show."
    ]


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    from scipy.stats import rankdata

    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return 0.0
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def _check_duplicates(curves: Sequence[ForceCurve]) -> None:
    names = [curve.name for curve in curves]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise CaphyError(f"two loadings are called {twice!r}: number loadings 1, 2, ... in the order they were made")


def _check_noise(curves: Sequence[ForceCurve]) -> None:
    """Raises where repeats have nothing in common."""
    groups: dict[tuple[str, str], list[ForceCurve]] = {}
    for curve in curves:
        groups.setdefault((curve.fabric, curve.direction), []).append(curve)
    for part in groups.values():
        top = min(curve.axial.max() for curve in part)
        at = np.linspace(0.2, 1, 9) * top
        forces = np.stack([_force_at(curve, at) for curve in part])
        if len(part) > 1 and forces.std(0).mean() > _NOISE * forces.mean():
            raise CaphyError(
                f"{_where(part[0])}: loadings differ by {100 * forces.std(0).mean() / forces.mean():.0f} % of their "
                "force: they have nothing in common that a model could explain; check the widths, units and names"
            )


def _force_at(curve: ForceCurve, strain: np.ndarray) -> np.ndarray:
    order = np.argsort(curve.axial)
    return np.interp(strain, curve.axial[order], curve.force[order])


def _where(curve: ForceCurve) -> str:
    return f"{curve.source + ': ' if curve.source else ''}{curve.name}"
