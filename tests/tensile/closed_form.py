"""Tensile tests by hand: the strip's balance across solved for each strain, without caphy's energies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from caphy.io.measurements import ForceCurve


@dataclass(frozen=True)
class Sheet:
    """Second Piola-Kirchhoff stress of an orthotropic sheet [N/m] in Green strains a (along the pull) and t (across).

    S_a = k_aa a + k_at t + q (a^2 + t^2) a, and the same across; friction adds tau against the path.
    """

    weft: float
    warp: float
    both: float
    fourth: float = 0.0
    friction: float = 0.0

    def curve(self, strain: np.ndarray, direction: str) -> tuple[np.ndarray, np.ndarray]:
        """Force per width [N/m] and transverse strain at engineering strains (N,) from 0."""
        along, across = (self.weft, self.warp) if direction == "weft" else (self.warp, self.weft)
        force, narrow, last = np.zeros(len(strain)), np.zeros(len(strain)), (0.0, 0.0)
        for i, e in enumerate(strain):
            a = e + 0.5 * e * e

            def resisted(t: float, a: float = a, last: tuple[float, float] = last) -> tuple[float, float]:
                step = np.array([a - last[0], t - last[1]])
                length = np.linalg.norm(step)
                rub = self.friction * step / length if length > 0 else np.zeros(2)
                stiff = self.fourth * (a * a + t * t)
                return along * a + self.both * t + stiff * a + rub[0], across * t + self.both * a + stiff * t + rub[1]

            t = float(brentq(lambda t: resisted(t)[1], -0.4999, 0.3, xtol=1e-12)) if i else 0.0  # pyright: ignore
            force[i], narrow[i] = (1 + e) * resisted(t)[0], np.sqrt(1 + 2 * t) - 1
            last = a, t
        return force, narrow


def measured(
    sheet: Sheet,
    top: float,
    seed: int = 0,
    loadings: int = 5,
    fabric: str = "cloth",
    scatter: float = 0.03,
    law: Callable[[np.ndarray, np.ndarray, int], np.ndarray] | None = None,
) -> list[ForceCurve]:
    """Loadings of both directions up to a strain; every strip of cloth is a little stiffer or softer than the last.

    ``law`` turns strains, forces and the loading's number into other forces.
    """
    random = np.random.default_rng(seed)
    strain, curves = np.linspace(0, top, 120), []
    for direction in ("weft", "warp"):
        clean, narrow = sheet.curve(strain, direction)
        for loading in range(1, loadings + 1):
            said = clean if law is None else law(strain, clean, loading)
            force = said * (1 + scatter * random.normal()) + 0.002 * clean.max() * random.normal(size=len(strain))
            across = narrow * (1 + scatter * random.normal()) + 0.001 * random.normal(size=len(strain))
            force[0] = 0.0
            curves.append(ForceCurve(fabric, direction, loading, strain, across, force))
    return curves


def softened(share: float) -> Callable[[np.ndarray, np.ndarray, int], np.ndarray]:
    """From the second loading on the tension is (1 - s (1 - W / W_m)) of the first loading's, W the work so far."""

    def law(strain: np.ndarray, force: np.ndarray, loading: int) -> np.ndarray:
        work = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(strain) * (force[1:] + force[:-1]))])
        return force * (1 - share * (1 - work / work[-1])) if loading > 1 else force

    return law
