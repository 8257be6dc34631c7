"""How far models are from loadings they were not fitted to, against how far repeats are from each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caphy.tensile.fit import Bench, Fit
from caphy.tensile.loadings import Loading, Tests, rows_of

STAGES = ("as given", "parameters", "with effects")


@dataclass(frozen=True)
class CurveError:
    """One loading: root mean square errors of force over strain by stage [N/m], and what repeats differ by.

    Attributes:
        force: root mean square of the measured force [N/m].
        rms: stage -> error [N/m].
        transverse: stage -> error of the transverse strain; None where that was not measured.
        floor: the same error of the mean of the other repeats; None for a first loading, which has no other.
    """

    fabric: str
    direction: str
    loading: int
    force: float
    rms: Mapping[str, float]
    transverse: Mapping[str, float | None]
    floor: float | None

    def relative(self, stage: str) -> float:
        return self.rms[stage] / self.force


def curve_errors(
    tests: Sequence[Tests], stages: Mapping[str, np.ndarray], known: Sequence[Tests], own: bool
) -> list[CurveError]:
    """Errors of loadings whose residuals over the scatter are (L, 2, B) in each stage.

    ``known``: the tests that repeats are taken from for the floor; ``own`` tells that a loading is one of them.
    """
    found = []
    for i, (test, loading) in enumerate(rows_of(tests)):
        rms = {stage: _rms(residual[i, 0] * test.scatter[0], loading.force) for stage, residual in stages.items()}
        across = {stage: _rms(r[i, 1] * test.scatter[1], loading.transverse) for stage, r in stages.items()}
        found.append(
            CurveError(
                test.fabric,
                test.direction,
                loading.curve.loading,
                float(np.sqrt(np.nanmean(loading.force**2))),
                {stage: float(value or 0.0) for stage, value in rms.items()},
                across,
                _floor(test, loading, known, own),
            )
        )
    return found


def _rms(error: np.ndarray, measured: np.ndarray) -> float | None:
    seen = np.isfinite(measured)
    return float(np.sqrt(np.mean(error[seen] ** 2))) if seen.any() else None


def _floor(test: Tests, loading: Loading, known: Sequence[Tests], own: bool) -> float | None:
    same = [t for t in known if (t.fabric, t.direction) == (test.fabric, test.direction)]
    repeats = [r for t in same for r in t.loadings if r.used == loading.used and not (own and r is loading)]
    if not repeats:
        return None
    stack = np.stack([r.force for r in repeats])
    count = np.isfinite(stack).sum(0)
    mean = np.where(count > 0, np.nansum(stack, 0) / np.maximum(count, 1), np.nan)
    error = mean - loading.force
    return _rms(error, error)  # none where it shares no strain with its repeats


def held_out_residual(fit: Fit, tests: list[Tests]) -> np.ndarray:
    """Residual over the scatter (L, 2, B) of other tests of the same fabric under a fit."""
    bench: Bench = fit.bench.with_tests(tests)
    return bench.residual(bench.curves(fit.numbers, fit.values))


def summary(errors: Sequence[CurveError]) -> dict:
    """Medians over loadings: relative errors by stage and of the floor, and errors in N/m."""
    if not errors:
        return {}
    stages = list(errors[0].rms)
    floors = [e.floor for e in errors if e.floor is not None]
    shares = [e.floor / e.force for e in errors if e.floor is not None]
    return {
        "loadings": len(errors),
        "relative": {stage: float(np.median([e.relative(stage) for e in errors])) for stage in stages},
        "rms_n_per_m": {stage: float(np.median([e.rms[stage] for e in errors])) for stage in stages},
        "floor_relative": float(np.median(shares)) if shares else None,
        "floor_n_per_m": float(np.median(floors)) if floors else None,
    }
