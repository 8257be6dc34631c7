"""What a fit takes away in each motion with the numbers that the other motions ask for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.refit.columns import from_the_end
from caphy.refit.evidence import ridged
from caphy.refit.fit import Fit, gone, summed

SURE = 2.0
"""Standard errors by which a misfit surely falls, or rises."""


@dataclass(frozen=True)
class Across:
    """Shares of the misfit of all windows that a model was fitted to, leaving one motion out at a time.

    Attributes:
        share, error: over all motions, and its standard error over windows.
        least: in the motion in which it is least.
    """

    share: float
    error: float
    least: float

    @property
    def holds(self) -> bool:
        """Whether misfit surely falls, and in each motion."""
        return self.least > 0 and self.share > SURE * self.error

    @property
    def fails(self) -> bool:
        """Whether misfit surely rises."""
        return self.share < -SURE * self.error


def across(fitted: Fit) -> Across | None:
    """None of a single motion.

    What mesh and steps get wrong differs from motion to motion: an effect that explains it where it was fitted does not
    explain it in another motion. (Leave-one-group-out cross-validation, on the quadratic forms at the fitted model.)
    """
    motion = np.array([response.scene for response in fitted.responses])
    every = np.unique(motion)
    if len(every) < 2:
        return None
    known, change = fitted.asked, fitted.change
    falls = gone(fitted.first, fitted.evidence, change, from_the_end(fitted.columns, change))
    whole = max(float((fitted.first.weight * fitted.first.c).sum()), 1e-300)
    for one in every:
        here = motion == one
        others = np.where(here, 0.0, known.weight)
        normal, right = np.einsum("w,wkl->kl", others, known.a), np.einsum("w,wk->k", others, known.b)
        slope, curvature = known.along(ridged(normal, right, 1e-9))
        falls[here] -= (slope + curvature / 2)[here] / whole
    return Across(*summed(falls), float(min(falls[motion == one].sum() for one in every)))
