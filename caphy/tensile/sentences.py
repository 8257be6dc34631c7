"""A diagnosis of tensile tests in plain sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caphy.effects.registry import find_effect

if TYPE_CHECKING:
    from caphy.tensile.diagnosis import CurveDiagnosis

_TRANSFER = {
    "own numbers": "with effects named on the others and numbers from one repeat of each direction",
    "their numbers": "with the others' relative numbers too and only a stiffness of its own",
}
_DEPENDS = 0.1  # share of the residual that a covariate must explain to be named


def said(diagnosis: CurveDiagnosis) -> list[str]:
    """The answer, the errors, what is left."""
    return [_verdict(diagnosis), *diagnosis.rivals, *_errors(diagnosis), *_fabrics(diagnosis), *_left(diagnosis)]


def _verdict(d: CurveDiagnosis) -> str:
    if d.verdict == "nothing":
        return "Nothing is missing: the model meets these tests within the scatter between repeats."
    if d.verdict == "parameters":
        return "No effect is missing, but the parameters are off: with the numbers below the model meets the tests."
    named = [_named(name, False) for name in d.found] + [_named(name, True) for name in d.found_used]
    if d.drift is not None:
        return (
            f"None of the known effects explains these tests: the force {'falls' if d.drift < 0 else 'rises'} by "
            f"{100 * abs(d.drift):.0f} % from each loading to the next, so it depends on the loading number."
        )
    if d.verdict == "named":
        return f"Missing: {'; '.join(named)}."
    partly = f" Nearest: {'; '.join(named)}, but {100 * d.left:.0f} % of the misfit is left." if named else ""
    return f"None of the known effects explains these tests.{partly}"


def _named(name: str, used: bool) -> str:
    about = (type(find_effect(name)).__doc__ or "").strip().split("\n")[0].rstrip(".").split(", E =")[0]
    return f"{name} ({about[:1].lower()}{about[1:]}){' from the second loading on' if used else ''}"


def _errors(d: CurveDiagnosis) -> list[str]:
    figures = d.summary
    if not figures:
        return []
    share, floor = figures["relative"], figures["floor_relative"]
    ends = f"; repeats themselves differ by {100 * floor:.0f} %" if floor is not None else ""
    if d.verdict == "nothing":
        return [f"The forces of loadings are {100 * share['as given']:.0f} % off{ends}."]
    return [
        f"Force of loadings that were left out (median rms over each, {figures['loadings']} loadings): "
        f"{100 * share['as given']:.0f} % off as given, {100 * share['parameters']:.0f} % with its parameters "
        f"refitted, {100 * share['with effects']:.0f} % with what was found{ends}."
    ]


def _fabrics(d: CurveDiagnosis) -> list[str]:
    if not d.fabrics:
        return []
    sentences = []
    for key, how in _TRANSFER.items():
        told = [row[key]["relative"] for row in d.fabrics.values() if row[key]]
        if not told:
            continue
        middle = {stage: sum(each[stage] for each in told) / len(told) for stage in ("parameters", "with effects")}
        before, after = (100 * middle[stage] for stage in ("parameters", "with effects"))
        verb = "falls" if after < before else "rises"
        sentences.append(
            f"On fabrics that were left out, {how}, the error {verb} from {before:.0f} % to {after:.0f} % "
            f"(mean of {len(told)})."
        )
    return sentences


def _left(d: CurveDiagnosis) -> list[str]:
    if d.verdict in ("nothing", "parameters"):
        return []
    shares = d.dependence.shares
    single = {k: v for k, v in shares.items() if " " not in k or k == "loading number"}
    if d.complete:
        return ["What is left is within the scatter between repeats."]
    sentences = [
        f"Part of it is none of the known effects: {100 * d.left:.0f} % of the squared misfit that refitted parameters "
        "leave remains."
    ]
    if d.doubtful:
        sentences.append(f"Until that has a name, {_listed(d.doubtful)} may be standing in for it.")
    largest = max(shares, key=lambda name: shares[name])
    if shares[largest] > _DEPENDS:
        alone = max(single, key=lambda name: single[name])
        more = f", of {alone} alone {100 * single[alone]:.0f} %" if alone != largest and single[alone] > 0 else ""
        sentences.append(
            f"What is left is a function of {largest} ({100 * shares[largest]:.0f} % of its squares){more}."
        )
    return [*sentences, *d.dependence.sentences[:4]]


def _listed(names: tuple[str, ...]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
