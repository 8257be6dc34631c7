"""``caphy compare MODEL MEASUREMENT... -o DIR``: where a model fails, when, and how much of it is noise."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from caphy.commands.output import OUTPUT
from caphy.commands.unfinished import UNFINISHED, unfinished
from caphy.errors import CaphyError
from caphy.io.places import writable_folder, write_text

if TYPE_CHECKING:
    from caphy.effects.model import Model
    from caphy.io.bundle import AvatarBundle
    from caphy.io.measurements import Measurement
    from caphy.measure.comparison import Comparison
    from caphy.measure.prediction import Prediction
    from caphy.measure.scene import Scene
    from caphy.refit.crew import Crew
    from caphy.report.page.compose import Section

_UNFINISHED = f"{UNFINISHED}-comparison"  # the folder may hold an unfinished diagnosis too


@dataclass(frozen=True)
class Compare:
    """Compare a model with measurements: compare.json with every figure, and compare.html to look at."""

    model: tyro.conf.Positional[str]
    """A physics model's JSON, "snug", a measured fabric's name, or the folder of a trained avatar ("default" is
    the one that comes along)."""
    measurements: tyro.conf.Positional[tuple[Path, ...]]
    """Measurements: .npz files, folders, or .csv tables of tensile tests; see docs/measurements.md."""
    output: Annotated[Path, OUTPUT]
    """Folder for the results."""
    garment: str | None = None
    """The garment's .npz where the measurement carries no rest shape; for an avatar the garment's name."""
    body: str | None = None
    """An SMPL-X-format .npz, or "medium" or "fine" for the bundled body; medium unless given."""
    window: int = 8
    """Frames that a physics model runs before it is restarted from the measurement, of those that are kept of films
    above 45 Hz."""
    effect_file: tuple[Path, ...] = ()
    """Python files with effects of your own that the model uses."""


def main(arguments: list[str]) -> None:
    """Run ``caphy compare`` with the arguments after it."""
    command = tyro.cli(Compare, args=arguments, prog="caphy compare")
    if not command.measurements:
        raise CaphyError("give at least one measurement")
    if command.window < 1:
        raise CaphyError(f"--window must be at least one frame, got {command.window}")
    writable_folder(command.output)
    tables = [path for path in command.measurements if path.suffix.lower() == ".csv"]
    curves = [_compared_curves(command, path) for path in tables]
    films = [path for path in command.measurements if path not in tables]
    title = f"{_title(Path(command.model))} against {_listed(command.measurements)}"
    with unfinished(command.output / _UNFINISHED) as kept:
        write(_compared(command, films, kept), curves, title, command)


def write(comparisons: Sequence[Comparison], curves: Sequence[dict], title: str, command: Compare) -> None:
    """Write compare.json and compare.html, and say the sentences."""
    from caphy import __version__
    from caphy.measure.pictures import section
    from caphy.report.page.compose import comparison_page

    facts = {"model": command.model, "written by": f"caphy {__version__}"}
    sections: list[Section] = [section(comparison) for comparison in comparisons]
    page = comparison_page(title, sections, facts, curves)
    figures = [comparison.figures for comparison in comparisons]
    document = {"schema": "caphy-comparison-1", **facts, "comparisons": figures, "force_curves": list(curves)}
    written = {"compare.json": json.dumps(document, indent=1, allow_nan=False), "compare.html": page}
    for name, text in written.items():
        write_text(command.output / name, text)
    for name, sentences in [(f["measurement"]["name"], f["sentences"]) for f in figures] + [
        (table["name"], table["sentences"]) for table in curves
    ]:
        print(f"\n{name}\n" + "\n".join(f"  {sentence}" for sentence in sentences))
    print(f"\n{command.output / 'compare.html'}")


def load_model(name: str, effect_files: Sequence[Path] = ()) -> Model | AvatarBundle:
    """The physics model of a JSON file or name, or the avatar in a folder or that comes along; raises
    :class:`CaphyError`."""
    from caphy.effects.model import Model
    from caphy.effects.own import use_file
    from caphy.effects.presets import fabric_model, snug_model
    from caphy.io.bundle import MANIFEST, read_bundle
    from caphy.io.bundled import bundled
    from caphy.material.fabrics import fabric_names

    path, named = Path(name), name in ("snug", *fabric_names())
    folder = bundled(path)
    if folder.is_dir() and (not named or (folder / MANIFEST).is_file()):  # a page may lie in a folder called snug
        return read_bundle(folder)

    for file in effect_files:
        use_file(file)
    if path.suffix == ".json" or (path.exists() and not path.is_dir()):
        return Model.load(path)
    if name == "snug":
        return snug_model()
    if name in fabric_names():
        return fabric_model(name)
    raise CaphyError(
        f"there is no model {name!r}: give a physics model's JSON, an avatar's folder, default (the avatar that comes "
        f"along), snug, or one of the fabrics {', '.join(fabric_names())}"
    )


def _compared_curves(command: Compare, path: Path) -> dict:
    from caphy.effects.model import Model
    from caphy.io.measurements import read_force_curves
    from caphy.measure.uniaxial import compare_curves
    from caphy.tensile.checks import far_stretched, loading_branch, require_tension, unloading

    model = load_model(command.model, command.effect_file)
    if not isinstance(model, Model):
        raise CaphyError(f"{path}: force curves are compared with a physics model, not with an avatar")
    curves = read_force_curves(path)
    for curve in curves:
        require_tension(curve)
    for note in far_stretched(curves):
        print(f"Note: {note}")
    rising = [loading_branch(curve) for curve in curves]
    found = compare_curves(model, rising, path.stem, str(path))
    return found | {"sentences": [*found["sentences"], *unloading(curves, rising)]}


def _compared(command: Compare, films: Sequence[Path], kept: Path) -> list[Comparison]:
    from caphy.effects.model import Model
    from caphy.io.measurements import read_measurement
    from caphy.measure.remarks import remarks

    if not films:
        return []
    model, measured = load_model(command.model, command.effect_file), [read_measurement(path) for path in films]
    for note in remarks(measured, every_frame=not isinstance(model, Model)):
        print(f"Note: {note}.")
    if isinstance(model, Model):
        return _with_physics(command, model, measured, kept)
    return [_with_avatar(command, model, measurement) for measurement in measured]


def _with_physics(command: Compare, model: Model, measured: Sequence[Measurement], kept: Path) -> list[Comparison]:
    import torch

    from caphy.commands.body import load_body
    from caphy.garment.template import Garment
    from caphy.measure.comparison import compare
    from caphy.measure.scene import Scene
    from caphy.refit.crew import Crew

    torch.set_num_threads(1)  # of many small matrices: two threads take half as long again
    garment = None if command.garment is None else Garment.load(command.garment)
    body = None if command.body is None else load_body(command.body)
    scenes = [Scene.of(measurement, garment, body) for measurement in measured]
    found = []
    with Crew(command.effect_file, kept=kept) as crew:
        for scene in scenes:
            with Progress(scene.measurement.name) as progress:
                prediction = predicted(scene, model, progress, crew, command.window)
                progress("comparing", 1, 1)
            found.append(compare(prediction, scene.measurement, scene.regions))
    return found


def predicted(scene: Scene, model: Model, progress: Progress, crew: Crew, length: int = Compare.window) -> Prediction:
    """What a physics model says where a measurement was taken, in windows of ``length`` frames; clouds are registered
    with its help."""
    from caphy.measure.prediction import predict_in_windows
    from caphy.refit.clouds import all_registered

    (known,) = all_registered([scene], model, progress, crew)
    prediction = predict_in_windows(known, model, length, progress, crew.predict)
    return replace(prediction, registered=scene.measurement.registered)


def _with_avatar(command: Compare, bundle: AvatarBundle, measurement: Measurement) -> Comparison:
    import numpy as np

    from caphy.measure.avatar import matching_garment, predict_with_avatar
    from caphy.measure.comparison import compare

    for option, given in (
        ("--body", command.body is not None),
        ("--window", command.window != Compare.window),
        ("--effect-file", bool(command.effect_file)),
    ):
        if given:
            raise CaphyError(
                f"{option} is for physics models; {command.model} is an avatar, which moves as it was trained"
            )
    garment = matching_garment(measurement, bundle, command.garment)
    prediction = predict_with_avatar(measurement, bundle, garment)
    names = np.array(garment.mesh.region_names)[garment.mesh.region]
    own = measurement.regions if prediction.registered else None
    return compare(prediction, measurement, names if own is None else own)


class Progress:
    """A bar for one part of the work after another, each with an estimate of its own, on the error stream.

    How many parts there will be nobody knows: it says how long all have taken."""

    def __init__(self, name: str, unit: str = "window") -> None:
        from tqdm import tqdm

        self._bar = tqdm(total=1, desc=name, unit=unit, leave=False)
        self._began = self._last = time.time()
        self._what = ""

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, what: str, done: int, total: int) -> None:
        if what != self._what or done < self._bar.n:
            self._bar.reset(total)
            self._bar.start_t = self._bar.last_print_t = self._last  # the first window of a part began with it
        self._what, self._last = what, time.time()
        minutes, seconds = divmod(int(self._last - self._began), 60)
        self._bar.total = total
        self._bar.set_postfix_str(f"{what}; {minutes}:{seconds:02d} in all", refresh=False)
        self._bar.update(done - self._bar.n)


def _title(path: Path) -> str:
    """A file's name without its ending; a folder's whole name."""
    return path.absolute().name if path.is_dir() else path.stem


def _listed(paths: Sequence[Path]) -> str:
    names = [_title(path) for path in paths]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
