"""The diagnosis: which physical effect a model lacks, how much of it, how sure that is, and what cannot be told."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from caphy.body.model import BodyModel
from caphy.diagnose.ambiguity import advice, alike
from caphy.diagnose.base import Base, base_of, checked_scenes
from caphy.diagnose.checks import require_one_cloth
from caphy.diagnose.groups import Group, columns_of
from caphy.diagnose.laws import settle_laws
from caphy.diagnose.noticed import LISTED, by_roll_outs, by_tangents
from caphy.diagnose.outside import Outside, outside
from caphy.diagnose.proof import each_proven
from caphy.diagnose.rivals import settle_rivals
from caphy.diagnose.search import Search, Term, least_wald, looked_again, ranked, search, take_back
from caphy.effects.model import Model
from caphy.errors import CaphyError, Diverged
from caphy.garment.template import Garment
from caphy.io.measurements import Measurement
from caphy.measure.remarks import remarks
from caphy.measure.track import Progress
from caphy.refit.across import Across, across
from caphy.refit.again import as_registered_first, fitted_again
from caphy.refit.columns import strengths
from caphy.refit.crew import Crew
from caphy.refit.descent import weighed_anew
from caphy.refit.heldout import Apart, HeldOut, rises_where_fitted
from caphy.refit.intervals import acts, intervals
from caphy.refit.responses import Response, median_mm
from caphy.refit.study import Study


@dataclass(frozen=True)
class Coefficient:
    """A fitted number: value, interval of 95 % and unit; "relative" of a change in proportion."""

    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Ranked:
    """One explanation as the screen saw it, before any refit.

    Attributes:
        label, name: for people; the effect's.
        own: it is a change of parameters that the model has.
        gain: share of the misfit gone in windows left out of its fit.
        needed: what it would have to be.
        wald: squared estimate over squared error.
        linear: first estimate of each number.
        refitted: share of the misfit gone after the refit, where it was refitted.
        noticed: smallest size of each number that would have been noticed here in 19 cases of 20, none where no size
            would: where nothing was named told by roll-outs of the numbers that the answer names, else by tangents.
        units: of each number; "relative" of a change of what the model has.
    """

    label: str
    name: str
    own: bool
    gain: float
    needed: float
    wald: float
    linear: dict[str, float]
    refitted: float | None
    noticed: Mapping[str, float | None]
    units: dict[str, str]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What was found.

    Attributes:
        verdict: "named", "parameters" (of the model's own effects, here or in base measurements already), "nothing" or
            "none of these".
        found: names of accepted effects, strongest first.
        groups: for each accepted effect the explanations that cannot be told from it here, itself first.
        advice: for each of those pairs, what would tell them apart.
        ranking: all explanations, best first, of those that gain as much the simplest.
        coefficients: of accepted effects, by "effect.parameter".
        model: with everything accepted and fitted.
        needed: gain that an effect had to reach.
        windows: how many there were.
        median_mm: median distance over the windows before and after.
        held_out: the same on held-out measurements, if there were any: of the model that base measurements leave, and
            with what was added, or where nothing was, of the one that was given and the former.
        by_base: likewise of the model that was given and the one that base measurements leave, where they differ.
        depends_on: what the force that is missing depends on, where no effect of the library explains it.
        seconds: what it took.
        search: everything behind it.
    """

    verdict: str
    found: tuple[str, ...]
    groups: dict[str, tuple[str, ...]]
    advice: dict[str, str]
    ranking: list[Ranked]
    coefficients: dict[str, Coefficient]
    model: Model
    needed: float
    windows: int
    median_mm: tuple[float, float]
    held_out: HeldOut | None
    by_base: HeldOut | None
    outside: Outside
    base: Base | None
    noise_mm: float | None
    seconds: float
    search: Search
    study: Study
    notes: tuple[str, ...] = field(default=())

    @property
    def depends_on(self) -> str | None:
        """What a missing force depends on, where the library has no name for it."""
        return self.outside.best if self.verdict == "none of these" else None


def diagnose(
    model: Model,
    measurements: Sequence[Measurement],
    base: Sequence[Measurement] | Base = (),
    held_out: Sequence[Measurement] = (),
    garment: Garment | None = None,
    body: BodyModel | None = None,
    progress: Progress | None = None,
    crew: Crew | None = None,
) -> Diagnosis:
    """Tell what a model lacks in measurements.

    Args:
        model: what the user believes.
        measurements: where it may fail; point clouds are registered with the model's help.
        base: measurements of the same cloth for which the model's effects are trusted: its parameters are fitted to
            them, and what they leave is what a solver and a mesh leave where nothing is missing. Or what an earlier
            diagnosis learned from them.
        held_out: measurements that nothing is fitted to.
        garment, body: as in :meth:`caphy.measure.scene.Scene.of`.
        progress: told what is being done.
        crew: shares the work.

    Raises:
        CaphyError: the measurements do not fit the cloth or are too short.
    """
    began = time.perf_counter()
    if not measurements:
        raise CaphyError("give at least one measurement to diagnose")
    trusted = () if isinstance(base, Base) else base
    require_one_cloth(diagnosed=measurements, base=trusted, held_out=held_out)
    every = (*measurements, *held_out)
    scenes = checked_scenes(every, model, garment, body, progress, crew)
    study = Study(scenes[: len(measurements)], progress=progress, crew=crew)
    others = Study(scenes[len(measurements) :], progress=progress, crew=crew) if held_out else None
    known = base if isinstance(base, Base) else base_of(model, base, garment, body, progress, crew)
    study.mesh = None if known is None else known.mesh
    start = model if known is None else known.model
    if known is not None and known.changed:
        study, others = study.registered_by(start), others and others.registered_by(start)
    found = search(study, start, model, known, others is not None)
    while (term := _doubtful(found, known, len(study.scenes))) is not None:
        take_back(study, found, term)

    apart = None
    if others is not None:
        known_of = () if known is None else columns_of(found.screens[0].groups)[0]
        others.mesh = study.mesh
        apart = Apart(others, found.screens[0].variance, known_of, known)
        found = each_proven(study, found, apart.errors)
        settle_rivals(study, found, apart, known)
    settle_laws(study, found, apart)
    if known is None and found.fit is not None:
        found.fit = weighed_anew(study, found.fit)
    looked_again(study, found, model, known)
    elsewhere = outside(found, 0.0 if known is None else known.probes)
    concluded = _concluded(found, study, model, start, known, apart, elsewhere)
    notes = (*concluded.notes, *remarks((*measurements, *trusted, *held_out)))
    return replace(concluded, notes=notes, seconds=time.perf_counter() - began)


def _concluded(
    found: Search,
    study: Study,
    given: Model,
    start: Model,
    base: Base | None,
    apart: Apart | None,
    elsewhere: Outside,
) -> Diagnosis:
    first, terms = found.screens[0], found.terms
    notes = [*unconverged(first.responses), *_not_by_moved(study, base, apart)]
    numbers = _coefficients(found, base, len(study.scenes)) if terms else {}
    errors = None if apart is None or found.fit is None else apart.errors(found.fit)
    before = first.responses
    if terms and (reason := _not_believed(found, before, errors, numbers)):
        notes.append(_taken_back(terms, reason))
        terms = []
    if terms and not elsewhere.beats and found.fit is not None:
        again = fitted_again(study, found.fit, first.variance, base is None)
        if again is not None:
            found.fit, before, earlier = again.fit, again.before, numbers
            numbers = _coefficients(found, base, len(study.scenes))
            notes.append(_went(again.times, earlier, numbers))
            if apart is not None:
                there = apart.registered_by(again.fit.model)
                errors = there.errors(again.fit)
                notes += as_registered_first("held-out clouds", apart.study, there.study is not apart.study)
            # Clouds registered with it favour it more than the first ones did: here it must hold all the more.
            if reason := _not_believed(found, before, errors, numbers):
                notes.append(_taken_back(terms, reason))
                terms, before = [], first.responses
        else:
            notes += as_registered_first("clouds", study, False)
    verdict = "nothing"
    if elsewhere.beats:
        verdict = "none of these"
    elif terms:
        verdict = "parameters" if all(term.group.own for term in terms) else "named"
    elif base is not None and base.changed:
        verdict = "parameters"
    kept = terms if verdict in ("named", "parameters") else []
    by_base = None if base is None or not base.changed else _by_base(apart, given, start)
    if not kept:
        errors = by_base or (errors.unchanged if errors is not None else _of_none(apart, start))
    similar = _similar(found, kept)
    return Diagnosis(
        verdict=verdict,
        found=tuple(dict.fromkeys(term.group.name for term in kept if not term.group.own)),
        groups={name: (name, *(group.name for group in groups)) for name, groups in similar.items()},
        advice={
            f"{term.group.name} or {other.name}": advice(term.group, other)
            for term in kept
            for other in similar[term.group.name]
        },
        ranking=_ranking(found, base is not None, study if verdict == "nothing" else None),
        coefficients=numbers if kept else {},
        model=_kept(found.model, start, kept) if kept else start,
        needed=first.needed,
        windows=len(first.responses),
        median_mm=(median_mm(before), median_mm(found.fit.responses if kept and found.fit else before)),
        held_out=errors,
        by_base=by_base,
        outside=elsewhere,
        base=base,
        noise_mm=study.floor_mm,
        seconds=0.0,
        search=found,
        study=study,
        notes=tuple(notes),
    )


def _similar(found: Search, terms: Sequence[Term]) -> dict[str, list[Group]]:
    """What moves the cloth like accepted effects, by their names; of one there may be several, at other openings."""
    similar: dict[str, list[Group]] = {}
    for term in terms:
        every = [*similar.get(term.group.name, ()), *alike(found, term)]
        similar[term.group.name] = list({group.name: group for group in every}.values())
    return similar


def _by_base(apart: Apart | None, given: Model, start: Model) -> HeldOut | None:
    """What parameters that base measurements moved do to held-out errors; none where cloth flies apart without that."""
    try:
        return None if apart is None else apart.between(given, start)
    except Diverged:
        return None


def _of_none(apart: Apart | None, start: Model) -> HeldOut | None:
    """Held-out errors where nothing was accepted; none without such measurements, or where cloth flies apart there."""
    try:
        return None if apart is None else apart.of(start)
    except Diverged:
        return None


def _taken_back(terms: Sequence[Term], reason: str) -> str:
    return f"{', '.join(term.group.label for term in terms)} was taken back: {reason}"


def _went(times: int, earlier: Mapping[str, Coefficient], numbers: Mapping[str, Coefficient]) -> str:
    """What registering clouds again did to numbers, in words."""
    moved = [f"{name} from {earlier[name].value:.3g} to {number.value:.3g}" for name, number in numbers.items()]
    often = {1: "once", 2: "twice"}.get(times, f"{times} times")
    return f"clouds were registered again, {often}, by what was fitted to them; it moved {', '.join(moved)}"


def unconverged(responses: Sequence[Response]) -> list[str]:
    """In how many frames of windows the solver did not converge, in words; nothing where it did in all."""
    every = np.concatenate([response.converged for response in responses])
    if every.all():
        return []
    return [
        f"the solver did not converge in {np.sum(~every)} of the windows' {len(every)} frames: what it got wrong there "
        "looks like what a model lacks; check units and stiffnesses of the model first"
    ]


def _not_by_moved(study: Study, base: Base | None, apart: Apart | None) -> list[str]:
    """Where clouds could not be registered by the parameters that base measurements moved, and why, in words."""
    if base is None or not base.changed:
        return []
    failed = {"diagnosed": study.why_not, "held-out": apart.study.why_not if apart else ""}
    return [
        f"{whose} clouds were not registered again by the parameters that base measurements moved: {why}"
        for whose, why in failed.items()
        if why
    ]


def _kept(model: Model, start: Model, terms: Sequence[Term]) -> Model:
    """A model without what was added to look for it in the right place, and not found."""
    names = {*start.effects, *(term.group.name for term in terms)}
    return replace(model, effects={name: values for name, values in model.effects.items() if name in names})


def _doubtful(found: Search, base: Base | None, motions: int) -> Term | None:
    """Of several accepted effects the last of which no number differs from zero for sure."""
    if len(found.terms) < 2:
        return None
    assert found.fit is not None
    for term in reversed(found.terms):
        if not acts(found.fit, term.group.columns, base, motions):
            return term
    return None


def _acting(found: Search, numbers: Mapping[str, Coefficient]) -> dict[str, Coefficient]:
    """Of fitted numbers those that are zero where nothing acts."""
    assert found.fit is not None
    return {name: numbers[name] for name in strengths(found.fit.columns)}


def _proof(errors: HeldOut | None, found: Search) -> HeldOut | Across | None:
    """What a fit must hold on: measurements that were held out, or else each motion by the others' numbers."""
    return errors if errors is not None or found.fit is None else across(found.fit)


def _not_believed(
    found: Search, before: Sequence[Response], errors: HeldOut | None, numbers: Mapping[str, Coefficient]
) -> str:
    """Why what was found is taken back, in words; empty where it is believed."""
    assert found.fit is not None
    reason = unproven(found.taken, _proof(errors, found), _acting(found, numbers))
    return reason or rises_where_fitted(before, found.fit.responses)


def unproven(taken: float, proof: HeldOut | Across | None, numbers: Mapping[str, Coefficient]) -> str:
    """Why what takes away a share of the misfit is not believed; empty where it is. ``numbers`` are those that are zero
    where nothing acts."""
    if not any(number.low > 0 or number.high < 0 for number in numbers.values()):
        return "none of its numbers is surely different from zero"
    begin = f"it takes away {100 * taken:.0f} % of the misfit where it was fitted"
    if isinstance(proof, Across):
        rises = f"rises by {-100 * proof.share:.0f} % (error {100 * proof.error:.0f} %)"
        return f"{begin}; where each motion has the numbers of the others it {rises}" if proof.fails else ""
    if proof is None or proof.proves(taken):
        return ""
    return f"{begin}{_in_words(proof)}"


def _in_words(errors: HeldOut) -> str:
    """What a fit does elsewhere."""
    there = ""
    if (elsewhere := errors.across) is not None:
        there = f", {100 * elsewhere.share:z.0f} % (error {100 * elsewhere.error:.0f} %) with numbers of other motions"
    by = f"{'rises' if errors.share < 0 else 'falls'} by {100 * abs(errors.share):.1f} %"
    doubt = f"error {100 * errors.share_error:.0f} %"
    if errors.few is not None:
        few = errors.few
        doubt = (
            f"few windows decide: {100 * few.promise:.1f} % if right, up to {100 * max(few.chance, 0):.1f} % by chance"
        )
    return (
        f"{there}; on held-out measurements the misfit {by} ({doubt}), where the median went from "
        f"{errors.before_mm:.2f} to {errors.after_mm:.2f} mm"
    )


def _ranking(found: Search, sure_of_parameters: bool, study: Study | None) -> list[Ranked]:
    """All explanations; with a study roll-outs tell what would have been noticed."""
    first = found.screens[0]
    took = found.terms[0].took if found.terms else {}
    wald = least_wald(sure_of_parameters)
    ranking = []
    for score in ranked(first.scores, sure_of_parameters):
        names = [column.name for column in score.group.columns]
        needed = first.needed_by(score)
        label = score.group.label
        refitted = took.get(label)
        linear = dict(zip(names, map(float, score.change), strict=True))
        if study is not None and len(ranking) < LISTED:
            noticed = by_roll_outs(study, first, score, wald)
        else:
            noticed = by_tangents(first, score, wald)
        units = {c.name: c.unit for c in score.group.columns}
        of = score.group
        ranking.append(Ranked(label, of.name, of.own, score.gain, needed, score.wald, linear, refitted, noticed, units))
    return ranking


def _coefficients(found: Search, base: Base | None, motions: int) -> dict[str, Coefficient]:
    assert found.fit is not None
    return {name: Coefficient(*told) for name, told in intervals(found.fit, base, motions).items()}
