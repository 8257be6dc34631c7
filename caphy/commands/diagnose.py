"""``caphy diagnose MODEL MEASUREMENT... -o DIR``: which physical effect a model lacks."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from caphy.commands.before_after import before_and_after
from caphy.commands.compare import Progress, load_model
from caphy.commands.output import OUTPUT
from caphy.commands.unfinished import UNFINISHED, unfinished
from caphy.errors import CaphyError
from caphy.io.places import writable_file, writable_folder, write_text

if TYPE_CHECKING:
    from caphy.diagnose.diagnosis import Diagnosis
    from caphy.effects.model import Model
    from caphy.io.measurements import Measurement
    from caphy.refit.crew import Crew
    from caphy.refit.heldout import HeldOut


PROOF = "before_after.html"
"""Page of a diagnosis that shows the error fall on held-out measurements."""


@dataclass(frozen=True)
class Diagnose:
    """Tell which physical effect a model lacks: diagnosis.json, diagnosis.html, and the model with it, model.json.

    With held-out measurements, before_after.html shows the error fall there.
    """

    model: tyro.conf.Positional[str]
    """A physics model's JSON, "snug", or a measured fabric's name."""
    measurements: tyro.conf.Positional[tuple[Path, ...]]
    """Measurements: .npz files or folders, or .csv tables of tensile tests; see docs/measurements.md."""
    output: Annotated[Path, OUTPUT]
    """Folder for the results."""
    base: tuple[Path, ...] = ()
    """Measurements of the same cloth for which the model's effects are trusted: they fix parameters and floor."""
    held_out: tuple[Path, ...] = ()
    """Measurements that nothing is fitted to, to prove the answer."""
    garment: Path | None = None
    """The garment's .npz where the measurements carry no rest shape."""
    body: str | None = None
    """An SMPL-X-format .npz, or "medium" or "fine" for the bundled body; medium unless given."""
    effect_file: tuple[Path, ...] = ()
    """Python files with effects of your own, to be tried as well."""


def main(arguments: list[str]) -> None:
    """Run ``caphy diagnose`` with the arguments after it."""
    command = tyro.cli(Diagnose, args=arguments, prog="caphy diagnose")
    writable_folder(command.output)
    for name in ("model.json", "diagnosis.json"):
        writable_file(command.output / name, inputs=[command.model])
    model = physics_model(command.model, command.effect_file)
    tables = [path for path in command.measurements if path.suffix.lower() == ".csv"]
    if tables and len(tables) < len(command.measurements):
        raise CaphyError("give either measurements in motion or tables of tensile tests, not both at once")
    if tables:
        require_no_base(command.base)
        _diagnose_curves(command, model)
        return
    from caphy.refit.crew import Crew

    read = _read(command)  # before any process is begun
    with unfinished(command.output / UNFINISHED) as kept, Crew(command.effect_file, kept=kept) as crew:
        diagnosis = _diagnosed(command, model, read, crew)
        write(diagnosis, command, model)
        if command.held_out and diagnosis.verdict in ("named", "parameters"):
            _before_after(model, diagnosis.model, command, crew)


def require_no_base(base: tuple[Path, ...]) -> None:
    """Raises :class:`CaphyError` where base measurements are given beside tables of tensile tests."""
    if base:
        raise CaphyError("tables of tensile tests have no --base: parameters are fitted to all of their loadings")


def physics_model(name: str, effect_files: tuple[Path, ...]) -> Model:
    """The physics model of a JSON file or name; raises :class:`CaphyError` for an avatar."""
    from caphy.effects.model import Model

    model = load_model(name, effect_files)
    if not isinstance(model, Model):
        raise CaphyError(f"{name}: is an avatar; give the physics model it was trained with (a JSON)")
    return model


def _read(command: Diagnose) -> list[list[Measurement]]:
    """What is diagnosed, base and held-out measurements."""
    from caphy.io.measurements import read_measurement

    return [
        [read_measurement(path) for path in paths] for paths in (command.measurements, command.base, command.held_out)
    ]


def _diagnosed(command: Diagnose, model: Model, read: Sequence[Sequence[Measurement]], crew: Crew) -> Diagnosis:
    import torch

    from caphy.commands.body import load_body
    from caphy.diagnose.diagnosis import diagnose
    from caphy.garment.template import Garment

    torch.set_num_threads(1)  # of many small matrices: two threads take half as long again
    garment = None if command.garment is None else Garment.load(command.garment)
    body = None if command.body is None else load_body(command.body)
    with Progress("diagnosis") as progress:
        return diagnose(model, *read, garment=garment, body=body, progress=progress, crew=crew)


def write(diagnosis: Diagnosis, command: Diagnose, since: Model) -> None:
    """Say the results, and write them; ``since`` is the model that was diagnosed."""
    from caphy.diagnose.figures import figures, sentences, table

    print("\n" + table(diagnosis) + "\n")
    print("\n".join(sentences(diagnosis)), flush=True)
    told = figures(diagnosis)
    (command.output / PROOF).unlink(missing_ok=True)  # an earlier run's would tell of another answer
    write_text(command.output / "diagnosis.json", json.dumps(told, indent=1, allow_nan=False))
    write_text(command.output / "model.json", _with_history(diagnosis, since, command).to_json())
    page = command.output / "diagnosis.html"
    write_text(page, _page(diagnosis, told, command))
    print(f"\n{command.output / 'diagnosis.json'}\n{command.output / 'model.json'}\n{page}")
    following = next_command(diagnosis.verdict, diagnosis.found, command)
    if following:
        print(f"next: {shlex.join(following)}")


def _with_history(diagnosis: Diagnosis, since: Model, command: Diagnose) -> Model:
    """The model that a diagnosis ends with, and what it changed in its history."""
    new, base = diagnosis.model, diagnosis.base
    if new == since:
        return since
    read = [path.stem for path in (*command.measurements, *command.base)]
    found = "lacked " + " and ".join(diagnosis.found) if diagnosis.found else "parameters were off"
    if base is not None and base.changed and new != base.model:
        since = revised(base.model, since, "base: parameters were off", read[-len(command.base) :], diagnosis.by_base)
    return revised(new, since, f"diagnosis: {found}", read, diagnosis.held_out)


def revised(new: Model, since: Model, note: str, data: Sequence[str], held: HeldOut | None) -> Model:
    """A model with what changed ``since`` another in its history, and the held-out errors before and after."""
    errors = (None, None, None) if held is None else (held.before_mm, held.after_mm, held.floor_mm)
    before, after, floor = (None if error is None else error / 1e3 for error in errors)
    return new.revised(since, note, data=data, error_before=before, error_after=after, floor=floor)


def next_command(verdict: str, found: Sequence[str], command: Diagnose, refitted: str = "refitted.json") -> list[str]:
    """What to run after a diagnosis, as arguments; nothing where nothing is left to do.

    Effects that were found are added and fitted; parameters that were off have been fitted already, and how far the
    model's error has fallen is to be seen.
    """
    files = list(map(str, command.measurements))
    scene = {
        "garment": () if command.garment is None else (command.garment,),
        "body": () if command.body is None else (command.body,),
        "effect-file": command.effect_file,
    }
    if found:
        added = [argument for name in found for argument in ("--add", name)]
        options = {"base": command.base, "held-out": command.held_out, **scene}
        return ["caphy", "refit", command.model, *files, *added, *_options(options, command.output / refitted)]
    if verdict == "parameters":
        model = str(command.output / "model.json")
        shown = [*map(str, command.held_out)] or files  # nothing was fitted to the former
        return ["caphy", "compare", model, *shown, *_options(scene, command.output / "compared")]
    return []


def _options(options: Mapping[str, Sequence[Path | str]], output: Path) -> list[str]:
    given = [argument for name, values in options.items() if values for argument in (f"--{name}", *map(str, values))]
    return [*given, "-o", str(output)]


def _before_after(before: Model, after: Model, command: Diagnose, crew: Crew) -> None:
    from caphy.commands.body import load_body
    from caphy.garment.template import Garment
    from caphy.io.measurements import read_measurement

    proof = [read_measurement(command.held_out[0])]
    garment = None if command.garment is None else Garment.load(command.garment)
    body = None if command.body is None else load_body(command.body)
    page = command.output / PROOF
    write_text(page, before_and_after(Path(command.model).stem, before, after, proof, crew, garment, body))
    print(f"before and after, on measurements that nothing was fitted to: {page}")


def _page(diagnosis: Diagnosis, told: dict, command: Diagnose) -> str:
    from caphy import __version__
    from caphy.diagnose.pictures import force_pictures
    from caphy.report.page.compose import diagnosis_page

    try:
        pictures = force_pictures(diagnosis)
    except CaphyError:  # embreex is not installed; the page does without
        pictures = []
    facts = {"model": command.model, "windows": str(diagnosis.windows), "written by": f"caphy {__version__}"}
    return diagnosis_page(f"{Path(command.model).stem}: what is missing?", told, pictures, facts)


def _diagnose_curves(command: Diagnose, model: Model) -> None:
    from caphy.kept import Kept
    from caphy.tensile.run import diagnose_tables

    with unfinished(command.output / UNFINISHED) as folder:
        kept = Kept(folder, command.effect_file)
        answer = diagnose_tables(model, command.measurements, command.output, command.held_out, kept, command.model)
    (command.output / PROOF).unlink(missing_ok=True)  # an earlier run's, of films
    if answer.verdict in ("named", "none of these"):
        print("\n".join(after_curves(answer.found, answer.found_used, command)))


def after_curves(found: Sequence[str], found_used: Sequence[str], command: Diagnose) -> list[str]:
    """What to run after a diagnosis of tensile tests that found something, or names nothing, in lines.

    A refit adds effects to all loadings, and to used cloth those that remember alone: what else was found from the
    second loading on (``found_used``) is only in the models that the diagnosis wrote.
    """
    from caphy.tensile.candidates import HISTORY

    addable = [*found, *(name for name in found_used if name in HISTORY)]
    changed = ", ".join(name for name in found_used if name not in HISTORY)
    lines = []
    if changed:
        lines.append(
            f"caphy refit cannot change {changed} from the second loading on; the models above do (_first.json: of the "
            "first loading)"
        )
    if addable:
        lines.append(f"next: {shlex.join(next_command('named', addable, command, 'refitted'))}")
    elif not changed:
        lines.append("next: caphy effects new NAME")
    return lines
