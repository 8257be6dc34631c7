"""A diagnosis in figures, for files, and in sentences, for people."""

from __future__ import annotations

from collections.abc import Iterable

from caphy.diagnose.base import Base
from caphy.diagnose.diagnosis import Coefficient, Diagnosis
from caphy.diagnose.noticed import LISTED
from caphy.diagnose.search import least_wald
from caphy.effects.registry import find_effect
from caphy.refit.fit import FURTHEST

_LISTED = 12


def figures(diagnosis: Diagnosis) -> dict:
    """What ``diagnosis.json`` holds; every number is finite or null."""
    held = diagnosis.held_out
    base = diagnosis.base
    return {
        "schema": "caphy-diagnosis-1",
        "verdict": diagnosis.verdict,
        "found": list(diagnosis.found),
        "groups": {name: list(group) for name, group in diagnosis.groups.items()},
        "advice": diagnosis.advice,
        "depends_on": diagnosis.depends_on,
        "coefficients": {
            name: {"value": c.value, "low": c.low, "high": c.high, "unit": c.unit}
            for name, c in diagnosis.coefficients.items()
        },
        "windows": diagnosis.windows,
        "gain_needed": diagnosis.needed,
        "median_mm": {"before": diagnosis.median_mm[0], "after": diagnosis.median_mm[1], "noise": diagnosis.noise_mm},
        "held_out": None
        if held is None
        else {
            "before_mm": held.before_mm,
            "after_mm": held.after_mm,
            "noise_mm": held.floor_mm,
            "share_of_misfit_gone": held.share,
            "its_standard_error": held.share_error,
            "few_windows_decide": held.few and {"share_by_chance": held.few.chance, "share_if_right": held.few.promise},
            "across_motions": held.across
            and {"share": held.across.share, "its_standard_error": held.across.error, "least": held.across.least},
            "windows_before_mm": held.before.tolist(),
            "windows_after_mm": held.after.tolist(),
        },
        "base": None
        if base is None
        else {
            "gain": base.gain,
            "median_mm": base.median_mm,
            "parameters_changed": base.changed,
            "before": base.before and list(base.before.later),
            "mesh": base.mesh,
            "correction": dict(base.correction),
            "held_out_mm": diagnosis.by_base
            and {"before": diagnosis.by_base.before_mm, "after": diagnosis.by_base.after_mm},
        },
        "probes": diagnosis.outside.gains,
        "library_gain": diagnosis.outside.library,
        "ranking": [
            {
                "explanation": r.label,
                "effect": r.name,
                "family": find_effect(r.name).group,
                "gain": r.gain,
                "gain_needed": r.needed,
                "wald": r.wald,
                "first_estimate": r.linear,
                "gain_after_refit": r.refitted,
                "noticed_above": r.noticed,
                "units": r.units,
            }
            for r in diagnosis.ranking
        ],
        "seconds": diagnosis.seconds,
        "seconds_per_explanation": diagnosis.seconds / max(len(diagnosis.ranking), 1),
        "sentences": sentences(diagnosis),
    }


def sentences(diagnosis: Diagnosis) -> list[str]:
    """The answer in words, the most important first."""
    said = [_answer(diagnosis)]
    said += [_coefficient(name, c) for name, c in diagnosis.coefficients.items()]
    for name, group in diagnosis.groups.items():
        if len(group) > 1:
            said.append(f"These measurements cannot tell {name} from {_listed(group[1:])}.")
    said += [f"To tell {pair.replace(' or ', ' from ')}: {what}." for pair, what in diagnosis.advice.items()]
    before, after = diagnosis.median_mm
    most = "at most " if diagnosis.study.of_clouds else ""
    noise = "" if diagnosis.noise_mm is None else f"; noise alone gives {most}{diagnosis.noise_mm:.2f} mm"
    if diagnosis.coefficients:
        goes = "falls" if after < before else "rises"
        said.append(f"The median distance in the windows {goes} from {before:.2f} to {after:.2f} mm{noise}.")
    else:
        said.append(f"The median distance in the windows is {before:.2f} mm{noise}.")
    if diagnosis.held_out is not None and diagnosis.coefficients:
        held = diagnosis.held_out
        goes, but = "falls", ""
        if held.after_mm >= held.before_mm:
            goes, but = "goes", f", but the misfit falls by {100 * held.share:.1f} %, surely"
        said.append(f"On held-out measurements it {goes} from {held.before_mm:.2f} to {held.after_mm:.2f} mm{but}.")
    if diagnosis.base is not None:
        said += learned_of(diagnosis.base)
    if diagnosis.by_base is not None:
        held = diagnosis.by_base
        said.append(
            f"By the moved parameters the held-out median went from {held.before_mm:.2f} to {held.after_mm:.2f} mm."
        )
    return said + [f"Note: {note}." for note in diagnosis.notes]


def learned_of(base: Base) -> list[str]:
    """What base measurements did to the model, and how near it comes to them, in words."""
    said = []
    if base.before is not None:
        without, whole = base.before.median_mm
        said.append(
            f"The base measurements are taken to be of before {_listed(base.before.later, 'and')} came into the model. "
            f"It lies {without:.2f} mm from them without, {whole:.2f} mm with, and stays as it is."
        )
    if base.changed:
        moved = ", ".join(f"{name} {100 * by:+.3g} %{at_limit(by)}" for name, by in base.changed.items())
        said.append(f"The base measurements moved the model's parameters beforehand: {moved}.")
    if base.changed and base.why_not:
        said.append(f"Base clouds were not registered again by these parameters: {base.why_not}.")
    said.append(f"Of the base measurements a median distance of {base.median_mm:.2f} mm is left in the windows.")
    return said


def _answer(diagnosis: Diagnosis) -> str:
    best = diagnosis.ranking[0]
    if diagnosis.verdict == "named":
        share = 100 * (best.refitted if best.refitted is not None else best.gain)
        also = " and ".join(diagnosis.found)
        return f"The model lacks {also}: the best single explanation takes away {share:.0f} % of the misfit."
    if diagnosis.verdict == "parameters":
        told = dict.fromkeys(name.partition(".")[0] for name in diagnosis.base.changed) if diagnosis.base else {}
        return f"No effect is missing: the parameters of {_listed(diagnosis.groups or told, 'and')} are off."
    if diagnosis.verdict == "none of these":
        gain = 100 * diagnosis.outside.gains[diagnosis.outside.best]
        found = diagnosis.outside.after
        beat = diagnosis.outside.beat
        swings = "" if beat is None else f" ({beat:.1f} swings a second)"
        whole = f"what is left after {' and '.join(found)}" if found else "the misfit"
        return (
            f"Something is missing that none of the known effects explains: of {whole}, a force that "
            f"depends on {diagnosis.outside.best}{swings} takes away {gain:.0f} %, the best known effect "
            f"{100 * diagnosis.outside.library:.0f} %. Write it with: caphy effects new my_effect"
        )
    listed = [
        (name, value, _unit(r.units[name]))
        for r in diagnosis.ranking[:LISTED]
        for name, value in list(r.noticed.items())[:1]
    ]
    sizes = ", ".join(f"{name} {value:.2g}{unit}" for name, value, unit in listed if value is not None)
    never = [name for name, value, _ in listed if value is None]
    limit = f" Noticed would have been, for example, {sizes}." if sizes else ""
    limit += f" No size of {_listed(never)} would have been." if never else ""
    least = f"where {100 * best.needed:.1f} % are needed"
    if best.gain >= best.needed:
        sure = best.wald >= least_wald(diagnosis.base is not None)
        least += ", which roll-outs do not bear out" if sure else ", and is not sure enough"
    if diagnosis.search.terms:  # accepted, and taken back
        least = "but does not hold, as the notes say"
    return (
        f"Nothing is missing that these measurements could show: the best explanation ({best.label}) takes away "
        f"{100 * best.gain:z.1f} % of the misfit {least}.{limit}"
    )


def _coefficient(name: str, c: Coefficient) -> str:
    if c.unit == "relative":
        return f"{name} changes by {100 * c.value:+z.0f} % (95 %: {100 * c.low:+z.0f} to {100 * c.high:+z.0f} %)."
    unit = "" if c.unit == "1" else f" {c.unit}"
    return f"{name} = {c.value:.3g}{unit} (95 %: {c.low:.3g} to {c.high:.3g})."


def at_limit(by: float) -> str:
    """What is said of a relative change that ends where changes are cut off."""
    ends = not 1.01 / FURTHEST < 1 + by < 0.99 * FURTHEST
    return f", which is as far as it is moved ({FURTHEST:g} times): more or less may be right" if ends else ""


def _in_unit(name: str, value: float, unit: str) -> str:
    return f"{name.split('.', 1)[1]} {value:.3g}{_unit(unit)}"


def _unit(unit: str) -> str:
    return "" if unit == "1" else " (relative change)" if unit == "relative" else f" {unit}"


def _listed(names: Iterable[str], word: str = "or") -> str:
    names = list(names)
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"


def table(diagnosis: Diagnosis) -> str:
    """The first explanations as lines of text."""
    rows = [f"{'explanation':34s} {'gain':>7s} {'Wald':>8s} {'refit':>7s}  first estimate"]
    for r in diagnosis.ranking[:_LISTED]:
        numbers = ", ".join(_in_unit(name, value, r.units[name]) for name, value in list(r.linear.items())[:3])
        numbers += ", ..." if len(r.linear) > 3 else ""
        refit = "" if r.refitted is None else f"{100 * r.refitted:z.1f} %"
        rows.append(f"{r.label:34s} {100 * r.gain:z6.1f} % {r.wald:7.0f} {refit:>7s}  {numbers}")
    return "\n".join(rows)
