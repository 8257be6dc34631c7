"""Which effect a model lacks, told from tensile tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.io.measurements import ForceCurve
from caphy.tensile.between import between_loadings, contrasts, learned
from caphy.tensile.candidates import HISTORY, Candidates, candidates
from caphy.tensile.coefficients import Coefficient, coefficients
from caphy.tensile.errors import CurveError, curve_errors, held_out_residual, summary
from caphy.tensile.fit import Bench, Fit, fitted
from caphy.tensile.loadings import Fabrics, Tests, prepared
from caphy.tensile.numbers import Number, own
from caphy.tensile.search import Progress, Ranked, Search, numbers_of
from caphy.tensile.sentences import said
from caphy.tensile.transfer import shared_structure, transferred
from caphy.tensile.unexplained import Dependence, dependence, outside, share_left

MOSTLY = 0.5
"""Share of the misfit that must not be left for an answer to be a name."""
_FABRICS = 3  # needed to leave one out


@dataclass(frozen=True, eq=False)
class CurveDiagnosis:
    """The answer.

    Attributes:
        verdict: "named", "nothing" (the model is right within the scatter), "parameters" (it is, with other numbers) or
            "none of these".
        found: effects that are missing; those in ``found_used`` act from the second loading on.
        ranking: all candidates that were tried, best first, with gain and threshold.
        coefficients: of the refitted model, by fabric.
        loadings: errors of loadings left out of the fit, or of the held-out ones where given.
        fabrics: errors of fabrics that no number but one of stiffness was fitted to, by fabric; empty below three.
        left: share of the misfit that remains.
        dependence: what the remaining residual depends on.
        models: by fabric, of the first loading and of used cloth.
        unseen: effects that tensile tests cannot show, with the reason.
        ambiguity: sentences on what these tests cannot tell apart, and the test that would.
    """

    verdict: str
    found: tuple[str, ...]
    found_used: tuple[str, ...]
    ranking: tuple[Ranked, ...]
    coefficients: tuple[Coefficient, ...]
    loadings: tuple[CurveError, ...]
    fabrics: Mapping[str, dict]
    left: float
    dependence: Dependence
    models: Mapping[str, tuple[Model, Model]]
    unseen: Mapping[str, str]
    ambiguity: tuple[str, ...]
    cautions: tuple[str, ...]
    fits: Mapping[str, Mapping[str, Fit]]
    """Stage ("as given", "parameters", "with effects") -> fabric -> fit."""

    @property
    def summary(self) -> dict:
        """Medians of :attr:`loadings`."""
        return summary(self.loadings)

    @property
    def sentences(self) -> list[str]:
        """The answer in words."""
        return said(self)


def diagnose_curves(
    model: Model,
    curves: Sequence[ForceCurve],
    held_out: Sequence[ForceCurve] = (),
    progress: Progress | None = None,
) -> CurveDiagnosis:
    """Compare a model with tensile tests and name what it lacks.

    Args:
        model: physics model with a membrane.
        curves: loadings to learn from: of one or several fabrics, each fitted with numbers of its own.
        held_out: loadings or fabrics that are only foretold; else each loading is left out in turn.
        progress: called with (what, done, total).

    Raises:
        CaphyError: the curves are not what tensile tests give, or the model has nothing that acts in them.
    """
    learning, held, cautions = split(curves, held_out)
    seen = candidates(model)
    search = started(model, learning, seen)
    order = [name for name in seen.added if name not in HISTORY]
    names, ranking = search.chosen(order, list(learning), progress)
    return answer(search, seen, names, None, learning, held, cautions, ranking, progress)


def started(model: Model, fabrics: Fabrics, seen: Candidates) -> Search:
    """A search over fabrics; raises :class:`CaphyError` where the model has no elasticity in its plane."""
    elastic = [name for name in model.effects if name in seen.acting]
    if not elastic:
        raise CaphyError(
            f"the model has no effect that resists stretch (it has {', '.join(model.effects)}); add strain_stvk or "
            "strain_measured"
        )
    benches = {fabric: Bench.of(model, tests, seen.acting) for fabric, tests in fabrics.items()}
    return Search(benches, own(model, elastic))


def split(curves: Sequence[ForceCurve], held_out: Sequence[ForceCurve]) -> tuple[Fabrics, Fabrics, list[str]]:
    """Tests to learn from and tests to foretell, binned alike."""
    everything, cautions = prepared([*curves, *held_out])
    away = {curve.name for curve in held_out}
    learning, held = {}, {}
    for fabric, tests in everything.items():
        for into, wanted in ((learning, False), (held, True)):
            part = [t for test in tests if (t := test.picked(lambda c, w=wanted: (c.name in away) == w)).loadings]
            if part:
                into[fabric] = part
    if not learning:
        raise CaphyError("every loading was held out or refused; give curves to learn from")
    return learning, held, cautions


def answer(
    search: Search,
    seen: Candidates,
    names: Sequence[str],
    names_used: Sequence[str] | None,
    learning: Fabrics,
    held: Fabrics,
    cautions: Sequence[str],
    ranking: Sequence[Ranked],
    progress: Progress | None = None,
) -> CurveDiagnosis:
    """The answer for effects that were chosen; those of used cloth are looked for unless given."""
    given = {fabric: _as_given(search, fabric) for fabric in learning}
    if not any(outside(fit.bench, fit.residual) for fit in given.values()):
        names, names_used = (), ()
    if progress:
        progress("comparing loadings", 0, 1)
    fits = search.fits(numbers_of(names))
    between = between_loadings(fits, [*seen.added]) if names_used is None else []
    if names_used is None:
        names_used = [row.effect for row in between[:1] if row.accepted]
    fits = {fabric: with_history(fit, names_used) for fabric, fit in fits.items()}
    stages = {"as given": given, "parameters": search.fits(), "with effects": fits}
    left = share_left(fits, stages["parameters"])
    verdict = _verdict(stages, [*names, *names_used], left)
    if verdict == "nothing":
        stages = dict.fromkeys(stages, given)
        fits = given
    return CurveDiagnosis(
        verdict,
        tuple(names),
        tuple(names_used),
        (*ranking, *between),
        tuple(coefficients(fits)),
        tuple(_loading_errors(stages, learning, held)),
        _fabric_errors(search, stages, names_used, held),
        left,
        dependence(fits),
        {fabric: fit.models for fabric, fit in fits.items()},
        seen.unseen,
        tuple(_ambiguity(search, names)),
        tuple(cautions),
        stages,
    )


def _as_given(search: Search, fabric: str) -> Fit:
    bench = search.benches[fabric]
    residual = bench.residual(bench.curves((), np.zeros(0)))
    return Fit(bench, (), np.zeros(0), residual, np.zeros((*residual.shape, 0)))


def with_history(fit: Fit, names: Sequence[str]) -> Fit:
    """A fit with effects of used cloth, learned from the first loading against the repeats, and the others refitted."""
    numbers: tuple[Number, ...] = numbers_of(names, used=True)
    for _ in range(2 if numbers else 0):  # the response grows with the stiffness, which the first round changes
        bare = replace(fit, bench=replace(fit.bench, held=()))
        rows = contrasts({"": bare}, numbers)
        if not rows:
            return fit
        values, _ = learned(rows)
        held = tuple(zip(numbers, map(float, values), strict=True))
        fit = fitted(replace(fit.bench, held=held), fit.numbers, fit.values)
    return fit


def _verdict(stages: Mapping[str, Mapping[str, Fit]], found: Sequence[str], left: float) -> str:
    off = {stage: any(outside(f.bench, f.residual) for f in fits.values()) for stage, fits in stages.items()}
    if not off["as given"] and not found:
        return "nothing"
    if not found:
        return "none of these" if off["parameters"] else "parameters"
    return "named" if left <= MOSTLY else "none of these"


def _loading_errors(stages: Mapping[str, Mapping[str, Fit]], learning: Fabrics, held: Fabrics) -> list[CurveError]:
    errors: list[CurveError] = []
    own_held = {fabric: tests for fabric, tests in held.items() if fabric in learning}
    for fabric in own_held or learning:
        known = learning[fabric]
        if own_held:
            residuals = {s: held_out_residual(fits[fabric], own_held[fabric]) for s, fits in stages.items()}
            errors += curve_errors(own_held[fabric], residuals, known, own=False)
        else:
            residuals = {stage: fits[fabric].left_out for stage, fits in stages.items()}
            errors += curve_errors(known, residuals, known, own=True)
    return errors


def _fabric_errors(
    search: Search, stages: Mapping[str, Mapping[str, Fit]], names_used: Sequence[str], held: Fabrics
) -> dict[str, dict]:
    """Errors of each fabric under numbers learned from the others, before and after; and which effects those name."""
    fits = stages["with effects"]
    strangers = {fabric: tests for fabric, tests in held.items() if fabric not in fits}
    rows = {}
    for fabric in strangers or (fits if len(fits) >= _FABRICS else {}):
        others = {f for f in fits if f != fabric}
        some = next(iter(fits.values())).bench
        bench = Bench.of(some.model, strangers[fabric], some.acting) if strangers else search.benches[fabric]
        residuals = {
            stage: transferred(bench, shared_structure({f: stages[stage][f] for f in others}))[0]
            for stage in ("parameters", "with effects")
        }
        tests: list[Tests] = bench.tests
        rows[fabric] = summary(curve_errors(tests, residuals, tests, own=True))
    return rows


def _ambiguity(search: Search, names: Sequence[str]) -> list[str]:
    """What these tests cannot tell apart."""
    fabric = next(iter(search.benches))
    fit = search.fit(fabric, numbers_of(names))
    held = [number for number in search.base if number not in fit.numbers]
    sentences = [
        f"{number.name} is held: pulls along weft and warp cannot tell it from {', '.join(names)}; a pull along the "
        "bias (45 degrees), which shears the cloth, would."
        for number in held
    ]
    return [
        *sentences,
        "Slow pulls along weft and warp say nothing of density, damping, drag or shear: weigh the cloth, film it move.",
    ]
