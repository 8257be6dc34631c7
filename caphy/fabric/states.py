"""Where the cloth lies in a scan: at rest under a model's forces and a soft pull to the scanned points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch

from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.fabric.attraction import AttractedPotential, Hits, find_hits
from caphy.fabric.stills import Worn
from caphy.kept import Kept
from caphy.solve.newton import Newton, Report

Stage = tuple[float, float]
"""How far points are looked for [m], and how hard the cloth is pulled to them [N/m^3]: pressure per distance."""

WEAK = 20.0
"""The pull under which the cloth comes to rest [N/m^3]: 1 cm of misfit weighs a tenth of a light cloth.

It keeps the cloth in the fold that was scanned and its equilibrium a proper minimum. It must be weak: what it takes of
the misfit, it takes from soft cloth more than from stiff, so that any misfit would make the cloth look soft.
"""
SEEK: tuple[Stage, ...] = ((0.06, 5000.0), (0.04, 5000.0), (0.03, 2000.0))
"""From a guess that does not know the scan into the folds that were scanned, hard at first."""
STRONG: Stage = (0.02, 500.0)
"""Then, and where a guess lies already, it is drawn to the scan before it is let go. Its forces must balance: what is
left of them CaPhy's squared gradient takes for the fabric's, and would bend it 2.5 times as hard without any noise."""
LET_GO: tuple[Stage, ...] = ((0.02, 100.0), (0.02, WEAK), (0.02, WEAK))
RESTED = 5e-3
"""Force on the worst vertex [N] up to which cloth counts as at rest: a few vertices' weight."""
AGAIN = 6
"""How often the last of these is taken up again, with fresh contact planes, where cloth has not come to rest."""
_SEEKING, _RESTING = 8, 25  # most Newton iterations of a stage


@dataclass(frozen=True, eq=False)
class Lying:
    """Cloth at rest in a scan.

    Attributes:
        x: positions (V, 3) [m], under the weak pull.
        drawn: positions (V, 3) [m] under the strong one, where the next look at this scan starts.
        hits: the points that are held against x.
        report: how the last minimisation ended.
    """

    x: np.ndarray
    drawn: np.ndarray
    hits: Hits
    report: Report

    @property
    def rests(self) -> bool:
        """Whether the forces are as good as balanced."""
        return self.report.residual <= RESTED


class Layer:
    """One garment's solver under one model, for all of its scans."""

    def __init__(self, model: Model, cloth: Cloth, kept: Kept | None = None) -> None:
        """``kept``: where cloth at rest is kept, and found again."""
        self._kept = Kept() if kept is None else kept
        self.potential = AttractedPotential(model, cloth)
        self.cloth = self.potential.cloth
        self.newton = Newton(self.potential, max_iterations=_RESTING)
        self._seeking = self.newton.within(1e-2)
        self._seeking.max_iterations = _SEEKING

    def lie(self, worn: Worn, guess: np.ndarray, seek: bool, rest: Sequence[Stage] = LET_GO) -> Lying:
        """The cloth at rest in a scan, near a guess (V, 3) [m]; the potential is left aimed at the scan.

        With ``seek`` the guess is taken to know nothing of the scan.

        Raises:
            CaphyError: too few of the scan's points lie near the garment.
        """
        key = self._kept.key("lie", self.potential.model, worn, guess, seek, rest)
        if (found := self._kept.recall(key)) is not None:
            report = Report(*(found[each.name].item() for each in fields(Report)))
            return self._let_lie(worn, found["x"], found["drawn"], report, rest[-1])
        x = torch.from_numpy(np.array(guess, dtype=float))
        for number, stage in enumerate(SEEK if seek else ()):
            x, _ = self._pulled(worn, x, stage, self._seeking, damping=1e3 if number == 0 else 0.0)
        x, _ = self._pulled(worn, x, STRONG, self.newton)
        drawn, report = x.numpy().copy(), Report(False, 0, np.inf, "not run")
        for stage in rest:
            x, report = self._pulled(worn, x, stage, self.newton)
        for _ in range(AGAIN):
            if report.residual <= RESTED:
                break
            x, report = self._pulled(worn, x, rest[-1], self.newton)
        told = {each.name: np.array(getattr(report, each.name)) for each in fields(Report)}
        self._kept.keep(key, {"x": x.numpy(), "drawn": drawn} | told)
        return self._let_lie(worn, x.numpy(), drawn, report, rest[-1])

    def _let_lie(self, worn: Worn, x: np.ndarray, drawn: np.ndarray, report: Report, last: Stage) -> Lying:
        hits = self._find(worn, torch.from_numpy(x), last[0])
        self.potential.aim(hits, last[1])
        return Lying(x, drawn, hits, report)

    def _pulled(
        self, worn: Worn, x: torch.Tensor, stage: Stage, newton: Newton, damping: float = 0.0
    ) -> tuple[torch.Tensor, Report]:
        reach, strength = stage
        self.potential.aim(self._find(worn, x, reach), strength)
        return newton.minimise(x, None, worn.seen, damping)

    def _find(self, worn: Worn, x: torch.Tensor, reach: float) -> Hits:
        hits = find_hits(worn.still.points, worn.facing, x.numpy(), self.cloth, reach)
        if len(hits) < ENOUGH * len(worn.still.points):
            raise CaphyError(
                f"{worn.still.name}: only {len(hits)} of {len(worn.still.points)} points lie within {100 * reach:g} cm "
                "of the garment; is the pose right, and are the points this garment's?"
            )
        return hits


ENOUGH = 0.3
"""Share of a scan's points that must lie near the garment."""
