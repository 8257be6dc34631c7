"""``caphy refit MODEL MEASUREMENT... --add EFFECT -o MODEL2``: add an effect, fit it, prove it on held-out data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from caphy.commands.before_after import before_and_after
from caphy.commands.compare import Progress
from caphy.commands.diagnose import physics_model, require_no_base, revised
from caphy.commands.following import following
from caphy.commands.output import OUTPUT
from caphy.commands.unfinished import UNFINISHED, unfinished
from caphy.errors import CaphyError
from caphy.io.places import writable_file, writable_folder, write_text

if TYPE_CHECKING:
    from caphy.body.model import BodyModel
    from caphy.diagnose.base import Base
    from caphy.effects.model import Model
    from caphy.garment.template import Garment
    from caphy.io.measurements import Measurement
    from caphy.refit.crew import Crew
    from caphy.refit.refit import Refit


@dataclass(frozen=True)
class RefitCommand:
    """Add effects to a model and fit them: the new model's JSON, and a page with before and after beside it.

    What held-out measurements contradict is refused: nothing is written, and the exit status is 1.
    """

    model: tyro.conf.Positional[str]
    """A physics model's JSON, "snug", or a measured fabric's name."""
    measurements: tyro.conf.Positional[tuple[Path, ...]]
    """Measurements: .npz files or folders, or .csv tables of tensile tests."""
    output: Annotated[Path, OUTPUT]
    """The new model, a .json; for tables of tensile tests a folder."""
    add: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Effects to add; without any the model's own parameters are fitted."""
    base: tuple[Path, ...] = ()
    """Measurements of the same cloth for which the model's effects are trusted, as in caphy diagnose."""
    held_out: tuple[Path, ...] = ()
    """Measurements that nothing is fitted to; without them every fourth window is held out."""
    garment: Path | None = None
    """The garment's .npz where the measurements carry no rest shape."""
    body: str | None = None
    """An SMPL-X-format .npz, or "medium" or "fine" for the bundled body; medium unless given."""
    effect_file: tuple[Path, ...] = ()
    """Python files with effects of your own."""


def main(arguments: list[str]) -> int:
    """Run ``caphy refit`` with the arguments after it; 1 where the fit is refused and nothing is written, or
    where of tables no effect that was asked for is kept."""
    command = tyro.cli(RefitCommand, args=arguments, prog="caphy refit")
    if not command.measurements:
        raise CaphyError("give at least one measurement")
    model = physics_model(command.model, command.effect_file)
    if all(path.suffix.lower() == ".csv" for path in command.measurements):
        from caphy.kept import Kept
        from caphy.tensile.run import refit_tables

        require_no_base(command.base)
        if command.output.suffix == ".json":
            raise CaphyError(
                f"{command.output}: for tables of tensile tests give a folder; each fabric gets a model in it"
            )
        writable_folder(command.output)
        writable_file(command.output / "refit.json", inputs=[command.model])
        with unfinished(command.output / UNFINISHED) as folder:
            kept = Kept(folder, command.effect_file)
            found = refit_tables(
                model, command.measurements, command.output, command.held_out, command.add, kept, command.model
            )
        return 1 if command.add and not found.kept else 0
    if command.output.suffix != ".json":
        raise CaphyError(f"{command.output}: the new model must be a .json file")
    writable_file(command.output)
    with unfinished(command.output.with_suffix(f".{UNFINISHED}")) as kept:
        return _refit(command, model, kept)


def _refit(command: RefitCommand, model: Model, kept: Path) -> int:
    import torch

    from caphy.commands.body import load_body
    from caphy.diagnose.base import base_of
    from caphy.diagnose.checks import require_one_cloth
    from caphy.diagnose.figures import learned_of
    from caphy.garment.template import Garment
    from caphy.io.measurements import read_measurement
    from caphy.measure.remarks import remarks
    from caphy.refit.crew import Crew
    from caphy.refit.refit import addable, refit

    addable(model, command.add)  # before the hours that base measurements take
    torch.set_num_threads(1)  # of many small matrices: two threads take half as long again

    garment = None if command.garment is None else Garment.load(command.garment)
    body = None if command.body is None else load_body(command.body)
    measured, proof = ([read_measurement(path) for path in paths] for paths in (command.measurements, command.held_out))
    calm = [read_measurement(path) for path in command.base]
    require_one_cloth(fitted=measured, base=calm, held_out=proof)
    for note in remarks((*measured, *calm, *proof)):
        print(f"Note: {note}.")
    with Crew(command.effect_file, kept=kept) as crew:
        with Progress("refit") as progress:
            learned = base_of(model, calm, garment, body, progress, crew)
            found = refit(model, measured, command.add, proof, garment, body, progress, crew, learned)
        print("\n".join([*learned_of(learned), table(found)] if learned else [table(found)]))
        if found.refused:
            print("The model stays as it was; nothing was written.")
            return 1
        _write(command, model, found, measured, proof, crew, garment, body, learned)
    return 0


def _write(
    command: RefitCommand,
    model: Model,
    found: Refit,
    measured: Sequence[Measurement],
    proof: Sequence[Measurement],
    crew: Crew,
    garment: Garment | None,
    body: BodyModel | None,
    learned: Base | None,
) -> None:
    """Write the model and its page, on which a measurement is shown before and after."""
    new = _with_history(command, model, found, learned)
    page = command.output.with_suffix(".html")
    name = Path(command.model).stem
    write_text(page, before_and_after(name, model, new, (proof or measured)[:1], crew, garment, body, found.notes))
    write_text(command.output, new.to_json())  # last: it may take the place of the model that a stopped run begins with
    print(f"\n{command.output}\n{page}")
    files = ("--effect-file", *command.effect_file) if command.effect_file else ()
    train = following("train", "--init", "AVATAR", "--model", command.output, *files)
    print(f"next: {train} ...   (the network learns it)")


def _with_history(command: RefitCommand, model: Model, found: Refit, learned: Base | None) -> Model:
    """The new model, and what base measurements and the refit changed, each as a revision of its own."""
    fitted, trusted = ([path.stem for path in paths] for paths in (command.measurements, command.base))
    if learned is not None and learned.changed:  # the errors before are of that model
        model = revised(learned.model, model, "base: parameters were off", trusted, None)
    note = f"refit{' with ' + ', '.join(found.kept) if found.kept else ' of its parameters'}"
    return revised(found.model, model, note, fitted, found.held_out)


def table(found: Refit) -> str:
    """The result as lines of text."""
    from caphy.diagnose.figures import at_limit

    held = found.held_out
    lines = [f"{'number':40s} {'value':>11s}   95 % interval"]
    for name, (value, low, high, unit) in found.coefficients.items():
        if unit == "relative":
            ends = f"{100 * low:+.3g} to {100 * high:+.3g} % of what it was{at_limit(value)}"
            lines.append(f"{name:40s} {100 * value:+9.3g} %   {ends}")
        else:
            lines.append(f"{name:40s} {value:11.4g}   {low:.4g} to {high:.4g}{'' if unit == '1' else f' {unit}'}")
    most = "at most " if held.of_clouds else ""
    floor = "" if held.floor_mm is None else f"; noise alone gives {most}{held.floor_mm:.2f} mm"
    lines += [
        f"misfit: {100 * found.share:z.1f} % less where it was fitted, {100 * held.share:z.1f} % less where it was not",
        f"held-out median distance: {held.before_mm:.2f} -> {held.after_mm:.2f} mm{floor}",
    ]
    lines += _held(found)
    lines += [found.reason] if found.reason else []
    return "\n".join(lines + [f"Note: {note}." for note in found.notes])


def _held(found: Refit) -> list[str]:
    """Parameters of added effects that are not fitted, and what they stay at."""
    from caphy.effects.registry import find_effect

    told = {name.partition("[")[0] for name in found.coefficients}
    lines = []
    for name in found.kept:
        effect = find_effect(name)
        for key, parameter in effect.parameters.items():
            if f"{name}.{key}" not in told:
                value = np.asarray(found.model.effects[name][key]).tolist()
                why = "" if key in effect.further else ": the effect is not linear in it"
                lines.append(f"{name}.{key} is held at {value} {parameter.unit}{why}")
    if any("not linear" in line for line in lines):
        lines.append("(an effect's `further` says which of these are to be fitted too, and where to look for them)")
    return lines
