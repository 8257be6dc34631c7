"""Which effect a model lacks, told from tensile tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caphy.effects.model import Model
from caphy.errors import CaphyError
from caphy.io.measurements import ForceCurve
from caphy.kept import Kept
from caphy.tensile.between import TOO_FEW, between_loadings, contrasts, learned
from caphy.tensile.candidates import HISTORY, Candidates, candidates
from caphy.tensile.coefficients import Coefficient, coefficients
from caphy.tensile.errors import CurveError, curve_errors, held_out_residual, summary
from caphy.tensile.fit import Bench, Fit
from caphy.tensile.loadings import Fabrics, prepared
from caphy.tensile.null import outside
from caphy.tensile.numbers import own
from caphy.tensile.search import Ranked, Say, Search, numbers_of
from caphy.tensile.sentences import said
from caphy.tensile.transfer import few_shot, shared_structure, transferred
from caphy.tensile.unexplained import Dependence, dependence, drift, share_left

MOSTLY = 0.3
"""Share of the misfit that may be left for an answer to be a name."""
_RIVAL = 0.8  # share of the best gain from which another effect counts as a rival
_FABRICS = 3  # needed to leave one out


@dataclass(frozen=True, eq=False)
class CurveDiagnosis:
    """The answer.

    Attributes:
        verdict: "named", "nothing" (the model is right within the scatter), "parameters" (it is, with other numbers) or
            "none of these".
        found: effects that are missing; those in ``found_used`` act from the second loading on.
        doubtful: those of them that remove less than is left after all: they may stand in for something unknown.
        ranking: all candidates that were tried, best first, with gain and threshold.
        coefficients: of the refitted model, by fabric.
        loadings: errors of loadings left out of the fit, or of the held-out ones where given.
        fabrics: errors of fabrics that no number but one of stiffness was fitted to, by fabric; empty below three.
        left: share of the misfit that remains.
        complete: whether that is within the scatter of repeats; if not, part of it is none of the known effects.
        dependence: what the remaining residual depends on.
        drift: change of force from one loading to the next, where it goes on and on; else None.
        models: by fabric, of the first loading and of used cloth.
        unseen: effects that tensile tests cannot show, with the reason.
        rivals: sentences on effects of used cloth that are nearly as good as the one that is named.
        ambiguity: sentences on what these tests cannot tell apart, and the test that would.
    """

    verdict: str
    found: tuple[str, ...]
    found_used: tuple[str, ...]
    doubtful: tuple[str, ...]
    ranking: tuple[Ranked, ...]
    coefficients: tuple[Coefficient, ...]
    loadings: tuple[CurveError, ...]
    fabrics: Mapping[str, dict]
    left: float
    complete: bool
    dependence: Dependence
    drift: float | None
    models: Mapping[str, tuple[Model, Model]]
    unseen: Mapping[str, str]
    rivals: tuple[str, ...]
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
    say: Say | None = None,
    kept: Kept | None = None,
) -> CurveDiagnosis:
    """Compare a model with tensile tests and name what it lacks.

    Args:
        model: physics model with a membrane.
        curves: loadings to learn from: of one or several fabrics, each fitted with numbers of its own.
        held_out: loadings or fabrics that are only foretold; else each loading is left out in turn.
        say: told of each fit that is about to be made.
        kept: where fits are kept, and found again.

    Raises:
        CaphyError: the curves are not what tensile tests give, or the model has nothing that acts in them.
    """
    learning, held, cautions = split(curves, held_out)
    seen = candidates(model)
    search = replace(started(model, learning, seen, kept), say=say)
    order, fabrics = [name for name in seen.added if name not in HISTORY], list(learning)
    names, ranking = search.chosen(order, fabrics)
    between = between_loadings(search.fits(numbers_of(names)), seen.added)
    if between and np.isinf(between[0].threshold):
        cautions = [*cautions, TOO_FEW]
    used = [row.effect for row in between[:1] if row.accepted]
    if used:  # what only repeats have must not be taken for a part of what all loadings have
        search = remembering(search, names, used)
        names, _ = search.chosen(order, fabrics, names)
    return answer(search, seen, names, used, learning, held, cautions, (*ranking, *between), order)


def started(model: Model, fabrics: Fabrics, seen: Candidates, kept: Kept | None = None) -> Search:
    """A search over fabrics; raises :class:`CaphyError` where the model has no elasticity in its plane."""
    kept = kept or Kept()
    elastic = [name for name in model.effects if name in seen.acting]
    if not elastic:
        raise CaphyError(
            f"the model has no effect that resists stretch (it has {', '.join(model.effects)}); add strain_stvk or "
            "strain_measured"
        )
    benches = {fabric: Bench.of(model, tests, seen.acting, kept) for fabric, tests in fabrics.items()}
    return Search(benches, own(model, elastic))


def split(curves: Sequence[ForceCurve], held_out: Sequence[ForceCurve]) -> tuple[Fabrics, Fabrics, list[str]]:
    """Tests to learn from and tests to foretell, binned alike."""
    everything, cautions = prepared(curves, held_out)
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
    used: Sequence[str],
    learning: Fabrics,
    held: Fabrics,
    cautions: Sequence[str],
    ranking: Sequence[Ranked],
    order: Sequence[str],
) -> CurveDiagnosis:
    """The answer for effects that were chosen, of all loadings and of those after the first."""
    bare = replace_benches(search, held=())
    given = {fabric: _as_given(bare, fabric) for fabric in learning}
    drifting = drift(given)
    if not (drifting or any(outside(fit) for fit in given.values())):
        names, used = (), ()
    search = remembering(search, names, used)
    fits = search.fits(numbers_of(names))
    stages = {"as given": given, "parameters": bare.fits(), "with effects": fits}
    left = share_left(fits, stages["parameters"])
    complete = not any(outside(fit) for fit in fits.values())
    verdict = "none of these" if drifting else _verdict(stages, [*names, *used], left)
    if verdict == "nothing":
        stages, fits = dict.fromkeys(stages, given), given
    return CurveDiagnosis(
        verdict=verdict,
        found=tuple(names),
        found_used=tuple(used),
        doubtful=() if complete else tuple(_doubtful(search, names, left)),
        ranking=tuple(ranking),
        coefficients=tuple(coefficients(fits)),
        loadings=tuple(_loading_errors(stages, learning, held)),
        fabrics={} if verdict in ("nothing", "parameters") else _fabric_errors(search, stages, names, order, held),
        left=left,
        complete=complete,
        dependence=dependence(fits),
        drift=drifting,
        models={fabric: fit.models for fabric, fit in fits.items()},
        unseen=seen.unseen,
        rivals=tuple(_rivals(ranking, used)),
        ambiguity=tuple(_ambiguity(search, names)),
        cautions=tuple(cautions),
        fits=stages,
    )


def _doubtful(search: Search, names: Sequence[str], left: float) -> list[str]:
    """Effects that remove less of the misfit than is left after all: they may stand in for what the library lacks."""
    whole = search.fits()
    doubtful = []
    for name in names:
        without = search.fits(numbers_of([n for n in names if n != name]))
        removed = share_left(without, whole) - left
        if removed < left:
            doubtful.append(name)
    return doubtful


def _as_given(search: Search, fabric: str) -> Fit:
    bench = search.benches[fabric]
    residual = bench.residual(bench.curves((), np.zeros(0)))
    return Fit(bench, (), np.zeros(0), residual, np.zeros((*residual.shape, 0)))


def remembering(search: Search, names: Sequence[str], used: Sequence[str]) -> Search:
    """The search with effects of used cloth known from the first loading against the repeats."""
    numbers = numbers_of(used, used=True)
    for _ in range(2 if numbers else 0):  # the response grows with the stiffness, which the first round changes
        benches = {}
        for fabric, fit in search.fits(numbers_of(names)).items():
            rows = contrasts({fabric: replace(fit, bench=replace(fit.bench, held=()))}, numbers)
            values = learned(rows)[0] if rows else np.zeros(len(numbers))
            held = tuple(zip(numbers, map(float, values), strict=True))
            benches[fabric] = replace(search.benches[fabric], held=held)
        search = Search(benches, search.base, search.say)
    return search


def replace_benches(search: Search, **changes: object) -> Search:
    """The search with benches changed."""
    return Search(
        {fabric: replace(bench, **changes) for fabric, bench in search.benches.items()}, search.base, search.say
    )


def _verdict(stages: Mapping[str, Mapping[str, Fit]], found: Sequence[str], left: float) -> str:
    off = {stage: any(outside(f) for f in fits.values()) for stage, fits in stages.items()}
    if not off["as given"] and not found:
        return "nothing"
    if not found:
        return "none of these" if off["parameters"] else "parameters"
    return "named" if left <= MOSTLY or not off["with effects"] else "none of these"


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
    search: Search, stages: Mapping[str, Mapping[str, Fit]], found: Sequence[str], order: Sequence[str], held: Fabrics
) -> dict[str, dict]:
    """What the other fabrics say of each that is left out, before and after.

    ``names``: effects that they name; ``own numbers``: errors where these are fitted to one repeat of each direction;
    ``their numbers``: errors with the others' relative structure and one number for the stiffness.
    """
    fits = stages["with effects"]
    strangers = {fabric: tests for fabric, tests in held.items() if fabric not in fits}
    some, rows = next(iter(fits.values())).bench, {}
    for fabric in strangers or (fits if len(fits) >= _FABRICS else {}):
        others = [f for f in fits if f != fabric]
        bench = Bench.of(some.model, strangers[fabric], some.acting, some.kept) if strangers else search.benches[fabric]
        bench = replace(bench, model=next(iter(stages["as given"].values())).bench.model)
        names = list(found) if strangers else search.chosen(order, others)[0]
        used = [fits[f].bench.held for f in others]
        mean = tuple((pair[0][0], float(np.mean([value for _, value in pair]))) for pair in zip(*used, strict=True))
        rest, few = few_shot(bench, search.base, names, mean)
        plain = {
            stage: transferred(bench, shared_structure({f: stages[stage][f] for f in others}))[0]
            for stage in ("parameters", "with effects")
        }
        rows[fabric] = {
            "names": names,
            "own numbers": summary(curve_errors(rest, few, bench.tests, own=True)),
            "their numbers": summary(curve_errors(bench.tests, plain, bench.tests, own=True)),
        }
    return rows


def _rivals(ranking: Sequence[Ranked], used: Sequence[str]) -> list[str]:
    """Whether other effects explain what repeats have nearly as well as the one that is named, in a sentence."""
    gains = {row.effect: row.gain for row in ranking if row.used and row.accepted}
    named = [name for name in used if name in gains]
    rivals = [name for name in gains if named and name not in used and gains[name] > _RIVAL * gains[named[0]]]
    if not rivals:
        return []
    listed = " and ".join(f"{name} ({100 * gains[name]:.0f} %)" for name in rivals)
    loop = "; unloading, which is not read here, would show it, since friction opens a loop"
    friction = loop if "hysteresis" in (named[0], *rivals) else ""
    return [
        f"From the second loading on {listed} explain{'s' * (len(rivals) == 1)} the difference nearly as well as "
        f"{named[0]} ({100 * gains[named[0]]:.0f} %): these curves do not decide{friction}."
    ]


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
