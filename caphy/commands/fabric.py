"""``caphy fabric RUN``: the stiffness of the clothes from the scans they were worn in."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import tyro

from caphy.commands.following import following
from caphy.commands.other_garments import still_told
from caphy.commands.unfinished import UNFINISHED, unfinished
from caphy.errors import CaphyError
from caphy.io.training_folder import NETWORK, OPTIONS
from caphy.kept import Kept

if TYPE_CHECKING:
    from caphy.effects.model import Model
    from caphy.evaluate.dressed import Subject
    from caphy.fabric.rounds import Fitted, Guess
    from caphy.fabric.stills import Worn

RESULT, PAGE = "fabric.json", "fabric.html"
TRAINED, ALTERNATED, AGAIN = "train", "fabric", "again"
KINDS: Final = ("upper", "lower")
POINTS = 8000
"""Points of a scan that are used at most, drawn at random."""


@dataclass(frozen=True)
class FabricCommand:
    """Fit stretching and bending tables of the garments in RUN to the scans that their networks are trained on."""

    run: tyro.conf.Positional[Path]
    """A run's folder, with what 'caphy register body', 'garments' and 'points' wrote."""
    fabric: str = "gray-interlock"
    """The measured fabric to start from."""
    model: Path | None = None
    """A physics model's JSON to start from instead."""
    upper_density: float | None = None
    """Weight of the upper garment's cloth [kg/m^2]; the starting fabric's unless given. Weigh it: scans cannot tell."""
    lower_density: float | None = None
    """The same of the lower garment's."""
    garments: tuple[Literal["upper", "lower"], ...] = KINDS
    """Which to fit; those that are not worn are passed over."""
    objective: Literal["response", "force"] = "response"
    """What is made small: the response, or with force CaPhy's squared gradient, which noise biases (docs/fabric.md)."""
    rounds: int = 12
    """Rounds at most."""
    mesh_corrections: int = 1
    """Times that each scan is solved on a mesh four times as fine, to take off what the mesh does; 0 saves time."""
    scans: int = 60
    """Scans used at most, spread over those there are."""
    alternations: int = 0
    """Times that RUN/train/GARMENT is trained on under the fabric found, into RUN/fabric, before fitting again."""
    steps: int = 500
    """Training steps of each."""


def main(arguments: list[str]) -> int:
    """Run ``caphy fabric`` with the arguments after it; 1 where a garment was left out."""
    options = tyro.cli(FabricCommand, args=arguments, prog="caphy fabric")
    _check(options)
    with unfinished(options.run / f"fabric.{UNFINISHED}") as kept:
        return _fitted(options, Kept(kept))


def _fitted(options: FabricCommand, kept: Kept) -> int:
    from caphy.evaluate.dressed import Subject
    from caphy.io.places import write_text
    from caphy.register.points import read_points

    base = _base(options)
    subject = Subject.read(options.run)
    if options.alternations:
        for kind in (kind for kind in options.garments if kind in subject.garments):
            _require_trainable(options.run, kind)
    points = read_points(options.run, "train")
    document: dict[str, Any] = {"format": "caphy-fabric-1", "garments": {}, "failed": {}}
    plots, sentences = {}, {}
    for kind in dict.fromkeys(options.garments):
        if kind not in subject.garments:
            continue
        try:
            found, model, start = _fit(options, base, subject, points, kind, kept)
        except CaphyError as error:
            print(f"without {kind}: {error}")
            document["failed"][kind] = str(error)
            continue
        path = _model_file(options.run, kind)
        write_text(path, model.to_json() + "\n")
        document["garments"][kind] = {**found, "model_file": path.name}
        plots[kind], sentences[kind] = _figures(start, model), _told(kind, found)
        print("\n".join(sentences[kind]))
    fitted = document["garments"]
    if not fitted:
        raise CaphyError(f"{options.run}: no garment's fabric could be fitted")
    rest = {kind: _model_file(options.run, kind) for kind in KINDS if kind not in options.garments}
    document["garments"] = still_told(options.run / RESULT, rest, "garments") | fitted
    failed = document["failed"]
    document["failed"] = {k: why for k, why in _failed_before(options.run).items() if k in rest} | failed
    for kind in failed:  # what an earlier fit could fit, this one may not
        _model_file(options.run, kind).unlink(missing_ok=True)
    if len(document["garments"]) == 1:  # then the file is a physics model as well
        (only,) = document["garments"].values()
        document |= only["model"]
    write_text(options.run / RESULT, json.dumps(document, indent=1, allow_nan=False) + "\n")
    _write_page(options.run / PAGE, plots, sentences)
    print(f"written: {options.run / RESULT}, {options.run / PAGE}")
    for kind in () if options.alternations else fitted:  # which are trained under it by turns
        print(f"next: {_training(options.run, kind)}")
    return 1 if failed else 0


def _training(run: Path, kind: str) -> str:
    """What trains a garment on under its fabric, from where the run's training came to and on its motions."""
    from caphy.commands.begun import option

    before, out = run / TRAINED / kind, run / ALTERNATED / kind
    words: list[object] = ["--scans", run, "--model", _model_file(run, kind)]
    poses: Sequence[Path] = ()
    if (before / NETWORK).is_file() and (before / OPTIONS).is_file():
        words += ["--init", before]
        poses = option("Path", json.loads((before / OPTIONS).read_text()).get("poses", ()), before.resolve())
    if (out / OPTIONS).is_file():  # a training is there already
        out = run / AGAIN / kind
    return following("train", f"{run / kind}.npz", *poses, *words, "-o", out)


def _failed_before(run: Path) -> dict[str, str]:
    """What an earlier run said of garments that it could not fit."""
    try:
        return dict(json.loads((run / RESULT).read_text(encoding="utf-8"))["failed"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _model_file(run: Path, kind: str) -> Path:
    return run / f"fabric_{kind}.json"


def _check(options: FabricCommand) -> None:
    for name, least in (("rounds", 1), ("scans", 3), ("steps", 1), ("alternations", 0), ("mesh_corrections", 0)):
        if getattr(options, name) < least:
            raise CaphyError(f"--{name.replace('_', '-')} must be at least {least}, got {getattr(options, name)}")
    for name in ("upper_density", "lower_density"):
        value = getattr(options, name)
        if value is not None and not 0.01 <= value <= 5:
            raise CaphyError(f"--{name.replace('_', '-')} must lie in [0.01, 5] kg/m^2, got {value:g}")


def _base(options: FabricCommand) -> Model:
    from caphy.commands.train import on_body
    from caphy.effects.model import Model
    from caphy.effects.presets import fabric_model
    from caphy.fabric.coefficients import Coefficients

    if options.model is None:
        model = fabric_model(options.fabric)
    else:
        model = on_body(Model.load(options.model), None, options.model)
    Coefficients.of(model)  # raises unless it can be fitted
    return model


def _start(options: FabricCommand, model: Model, kind: str) -> Model:
    density = options.upper_density if kind == "upper" else options.lower_density
    if density is None:
        print(f"note: {kind}: the cloth is taken to weigh {model.density:g} kg/m^2; all stiffnesses go with that")
        return model
    return replace(model, density=density)


def _fit(
    options: FabricCommand, base: Model, subject: Subject, points: Any, kind: str, kept: Kept
) -> tuple[dict[str, Any], Model, Model]:
    from caphy.fabric.certainty import Certainty
    from caphy.fabric.record import record, settled_model
    from caphy.fabric.rounds import fit_fabric

    start, (worn, left_out) = _start(options, base, kind), _worn(options, subject, points, kind)

    def say(number: int, done: int, total: int) -> None:
        if done % 10 == 0 or done == total:
            print(f"{kind}: round {number + 1} of at most {options.rounds}, scan {done} of {total}", flush=True)

    guess = _network(options.run / TRAINED, subject, kind)
    fitted = fit_fabric(worn, start, options.rounds, options.objective, guess, say, options.mesh_corrections, kept)
    for number in range(options.alternations):
        model = settled_model(fitted, Certainty.of(fitted))
        guess = _trained_on(options, subject, kind, model, number)
        after = fit_fabric(
            worn, model, options.rounds, options.objective, guess, say, options.mesh_corrections, kept, start
        )
        fitted = _again(fitted, after)
    sure = Certainty.of(fitted)
    model = settled_model(fitted, sure, tuple(one.still.name for one in worn))
    found = record(fitted, sure, model, options.objective)
    return {**found, "left_out": left_out | found["left_out"]}, model, start


def _again(before: Fitted, after: Fitted) -> Fitted:
    """The later fit, which was told over the first start, with the rounds of both."""
    return replace(after, numbers=before.numbers, rounds=(*before.rounds, *after.rounds), prior=after.numbers)


def _worn(options: FabricCommand, subject: Subject, points: Any, kind: str) -> tuple[list[Worn], dict[str, str]]:
    import numpy as np

    from caphy.fabric.stills import Still, Worn

    random = np.random.default_rng(0)
    chosen = [
        points[i]
        for i in np.unique(np.linspace(0, len(points) - 1, min(options.scans, len(points))).round().astype(int))
    ]
    worn: list[Worn] = []
    left_out: dict[str, str] = {}
    for scan in chosen:
        shown = getattr(scan, kind).astype(float)
        if len(shown) < LEAST_POINTS:
            left_out[scan.name] = f"shows only {len(shown)} points of the {kind} garment"
            print(f"left out: {scan.name}: {left_out[scan.name]}")
            continue
        kept = shown[np.sort(random.permutation(len(shown))[:POINTS])]
        worn.append(Worn(Still(scan.name, kept, scan.pose, scan.transl), subject.body, subject.garments[kind]))
    return worn, left_out


LEAST_POINTS = 200
"""Points that must show a garment for its scan to be used."""


def _network(folder: Path, subject: Subject, kind: str) -> Guess | None:
    """The network's held drape as a first guess, where there is a network."""
    if not (folder / kind / NETWORK).is_file():
        return None
    wearing = replace(subject, garments={kind: subject.garments[kind]}).wearing(folder)
    return lambda worn: wearing.held(worn.still.pose, worn.still.transl).garments[kind][0]


def _require_trainable(run: Path, kind: str) -> None:
    """Raise CaphyError where alternations, which come after rounds that may take hours, could not be."""
    from caphy.commands.begun import option
    from caphy.commands.onward import require_own

    folder = run / TRAINED / kind
    if not (folder / OPTIONS).is_file():
        raise CaphyError(f"{folder}: --alternations trains on what 'caphy train' wrote there, and it is no such folder")
    for name in ("poses", "held_out"):
        given = json.loads((folder / OPTIONS).read_text()).get(name, ())
        for path in option("Path", given, folder.resolve()):
            if not path.exists():
                raise CaphyError(f"{path}: motions that {folder} was trained on must be there for --alternations")
    require_own(run / ALTERNATED / kind)


def _trained_on(options: FabricCommand, subject: Subject, kind: str, model: Model, number: int) -> Guess | None:
    from caphy.commands.onward import onward
    from caphy.commands.train import reopen

    source = options.run / (TRAINED if number == 0 else ALTERNATED) / kind
    after = onward(reopen(source), model, options.steps, options.run / ALTERNATED / kind, seed=number + 1)
    after.run()
    return _network(options.run / ALTERNATED, subject, kind)


def _figures(start: Model, model: Model) -> list[str]:
    from caphy.fabric.curves import figures

    return figures({"start": start, "found": model})


def _told(kind: str, found: dict[str, Any]) -> list[str]:
    rounds = f"{len(found['rounds'])} round{'s' * (len(found['rounds']) != 1)}"
    lines = [f"{kind}: {found['scans']} scans, {rounds}" + ("" if found["settled"] else ", not settled")]
    for name, row in found["stiffness"].items():
        if row["interval"] is None:
            lines.append(f"  {name}: not determined by these scans; the start's table is kept")
        else:
            low, high = row["interval"]
            lines.append(f"  {name}: {row['over_the_start']:.2f} times the start's (95 %: {low:.2f} to {high:.2f})")
    return lines


def _write_page(path: Path, plots: dict[str, list[str]], sentences: dict[str, list[str]]) -> None:
    from caphy.fabric.curves import page
    from caphy.io.places import write_text

    write_text(path, page(plots, sentences))
