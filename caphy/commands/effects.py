"""``caphy effects list|show|check|new|history``."""

from __future__ import annotations

import inspect
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import numpy as np
import tyro

from caphy.commands.following import following
from caphy.commands.output import OUTPUT
from caphy.effects.base import Effect, Group, needs
from caphy.effects.registry import find_effect, register_file, registered_effects
from caphy.effects.scaffold import write_scaffold
from caphy.errors import CaphyError, EffectFailed
from caphy.io.bundle import MANIFEST

if TYPE_CHECKING:
    from caphy.effects.model import Model

EffectFiles = tuple[Path, ...]
_ALWAYS = {
    "documented", "finite", "gradient_is_slope", "hessian_is_slope", "degenerate_is_finite", "batch_equals_loop",
}  # fmt: skip
"""Properties that no effect rightly lacks."""


@dataclass(frozen=True)
class List:
    """List the physical effects, or the measured fabrics."""

    fabrics: bool = False
    """List the measured fabrics instead."""
    effect_file: EffectFiles = ()
    """Your own effects, as Python files."""


@dataclass(frozen=True)
class Show:
    """Show what an effect computes, its parameters with units and bounds, and where it comes from."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Names as listed by 'caphy effects list'."""
    effect_file: EffectFiles = ()
    """Your own effects, as Python files."""


@dataclass(frozen=True)
class Check:
    """Put effects to the test: derivatives, units, invariances, limits. Status 1 if any fails."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names as listed by 'caphy effects list'; those of the files if none are given."""
    effect_file: EffectFiles = ()
    """Your own effects, as Python files."""


@dataclass(frozen=True)
class New:
    """Begin an effect of your own: a Python file that works, for you to put your energy in."""

    name: Annotated[str, tyro.conf.Positional]
    """Its name, like my_effect."""
    output: Annotated[Path | None, OUTPUT] = None
    """The file to write; NAME.py here if not given."""
    effect_file: EffectFiles = ()
    """Your other effects, as Python files."""


@dataclass(frozen=True)
class History:
    """Show how a physics model came to be: what each revision changed, and what that did to the error."""

    model: Annotated[Path, tyro.conf.Positional]
    """A model's JSON, the folder of a training, or the folder of an avatar."""
    effect_file: EffectFiles = ()
    """Your own effects, as Python files."""


def main(arguments: list[str]) -> int:
    """Run ``caphy effects`` with the arguments after it."""
    command = tyro.cli(
        tyro.conf.OmitSubcommandPrefixes[
            Annotated[List, tyro.conf.subcommand("list")]
            | Annotated[Show, tyro.conf.subcommand("show")]
            | Annotated[Check, tyro.conf.subcommand("check")]
            | Annotated[New, tyro.conf.subcommand("new")]
            | Annotated[History, tyro.conf.subcommand("history")]
        ],
        args=arguments,
        prog="caphy effects",
    )
    own = [name for path in command.effect_file for name in register_file(path)]
    match command:
        case List(fabrics=True):
            _table(_fabric_rows())
        case List():
            _table(_effect_rows())
        case Show(names=()):
            raise CaphyError("name the effects to show; caphy effects list lists them")
        case Show():
            print("\n\n".join(_description(find_effect(name)) for name in command.names))
        case Check():
            return _check(command.names or tuple(own) or tuple(registered_effects()))
        case History(path):
            print("\n".join(_histories(path)))
        case New(name, output):
            path = output or Path(f"{name}.py")
            write_scaffold(name, path)
            print(f"wrote {path}; edit it, then: {following('effects', 'check', '--effect-file', path)}")
    return 0


def _table(rows: list[tuple[str, ...]]) -> None:
    print("\n".join(_lines(rows)))


def _lines(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]


def _histories(path: Path) -> list[str]:
    """Lines about a model's history, or of each garment's of an avatar."""
    from caphy.effects.model import Model
    from caphy.io.bundled import bundled

    path = bundled(path)
    if not (path / MANIFEST).is_file():
        return _history(Model.load(path / "model.json" if path.is_dir() else path))
    from caphy.io.bundle import read_bundle

    lines: list[str] = []
    for name, facts in read_bundle(path).provenance.get("garments", {}).items():
        lines += [f"{name}:", *_history(Model.from_json(json.dumps(facts.get("model", {})), f"{path}: {name}"))]
    return lines


def _history(model: Model) -> list[str]:
    from caphy.effects.history import history_rows

    effects = f"{', '.join(model.effects) or 'no effects'}; {model.density:.4g} kg/m^2"
    if not model.history:
        return [effects, "no revisions: it is as it was first written"]
    return [effects, *_lines(history_rows(model.history))]


def _effect_rows() -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("group", "effect", "element", "acts", "parameters", "what it is")]
    groups = get_args(Group)
    for name, effect in sorted(registered_effects().items(), key=lambda item: (groups.index(item[1].group), item[0])):
        acts = " ".join(["in motion"] * effect.needs_step + ["on a body"] * effect.needs_body) or "always"
        summary = inspect.getdoc(inspect.getmodule(effect)) or inspect.cleandoc(effect.__doc__ or "") or "-"
        parameters = ", ".join(f"{key} [{parameter.unit}]" for key, parameter in effect.parameters.items())
        rows.append((effect.group, name, effect.element, acts, parameters or "-", summary.splitlines()[0]))
    return rows


def _fabric_rows() -> list[tuple[str, ...]]:
    from caphy.material.fabrics import LOADED_TWICE, fabric, fabric_names

    head = ("fabric", "kg/m^2", "weft N/m", "warp N/m", "shear N/m", "bending weft, warp 1e-6 N m")
    rows: list[tuple[str, ...]] = [head]
    for name in fabric_names():
        cloth = fabric(name)
        weft, _, warp, shear = LOADED_TWICE * np.maximum(cloth.stretching[0], 0)
        bending = f"{cloth.bending[2, 0] * 1e6:.1f}, {cloth.bending[0, 0] * 1e6:.1f}"
        rows.append((name, f"{cloth.density:.3f}", f"{weft:.1f}", f"{warp:.1f}", f"{shear:.1f}", bending))
    return rows


def _description(effect: Effect) -> str:
    lines = [f"{effect.name} ({effect.group}, per {effect.element})", "", inspect.getdoc(effect) or ""]
    if effect.parameters:
        lines += ["", "Parameters"]
    for key, parameter in effect.parameters.items():
        bounds = f"in [{parameter.lower:g}, {parameter.upper:g}]"
        kind = "; the energy is linear in it" * parameter.linear
        default = str(np.asarray(parameter.default).tolist())
        lines.append(f"  {key} [{parameter.unit}] {bounds}: {parameter.doc}; default {default}{kind}")
    traits = [
        "internal: no net force or torque" * effect.internal,
        "acts only in motion" * effect.needs_step,
        "acts only on a body" * effect.needs_body,
        f"needs {needs(effect)}" * bool(effect.borrows),
        f"reads too, where there: {', '.join(effect.heeds)}" * bool(effect.heeds),
        f"looked for opening by opening: {', '.join(effect.separate)}" * bool(effect.separate),
        f"does nothing where zero: {', '.join(effect.coefficients)}" * bool(effect.coefficients),
    ]
    lines += ["", *filter(None, traits), f"Reference: {effect.reference}"]
    return "\n".join(lines)


def _check(names: tuple[str, ...]) -> int:
    failures = sum(_check_one(name) for name in names)
    print(f"{failures} failed" if failures else "all passed")
    return 1 if failures else 0


def _check_one(name: str) -> int:
    """Put one effect to the test; returns how many properties it fails."""
    from caphy.effects.battery import CHECKS

    failed, broke, lacks = [], [], find_effect(name).lacks
    for check in CHECKS:
        what, why = check.__name__.replace("_", " "), lacks.get(check.__name__)
        verdict = "ok" if why is None else f"FAILED  has what it says that it lacks ({why})"
        try:
            check(name)
        except EffectFailed as error:
            verdict = f"FAILED  {error.__cause__.__class__.__name__}: {error.__cause__}"
            broke.append(check.__name__)
        except CaphyError as error:  # what is no effect fails everything else as well
            print(f"{name}  {what}: FAILED  {error}; the rest was not tried")
            return len(failed) + 1
        except AssertionError as error:
            verdict = f"FAILED  {error}" if why is None else f"lacks it, as it says: {why}"
        except Exception as error:
            verdict = f"FAILED  {type(error).__name__}: {error}"
            broke.append(check.__name__)
        if verdict.startswith("FAILED"):
            failed.append(check.__name__)
        print(f"{name}  {what}: {verdict}")
    names = [check.__name__ for check in CHECKS]
    for key in lacks:
        if key not in names:
            failed.append(key)
            print(f"{name}  lacks: FAILED  there is no property {key!r}; there are {', '.join(sorted(names))}")
    rightly = [key for key in failed if key in names and key not in (*lacks, *broke)]
    if rightly and not _ALWAYS.intersection(failed):
        print(
            "mend it; only where physics wants it so may the effect say so, with the reason: "
            f'lacks = {{"{rightly[0]}": "the reason, in words"}}'
        )
    return len(failed)
