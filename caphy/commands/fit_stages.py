"""The stages of ``caphy fit``; all but the first two and the last are commands of their own."""

from __future__ import annotations

import importlib
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from caphy.commands.fit_scans import CHECKED, KINDS, LABELLED, LABELS, SCANS, check_scans, read, segment_scans
from caphy.commands.validate import REPORT as VALIDATION
from caphy.errors import CaphyError
from caphy.evaluate.learnt_from import TEMPLATES
from caphy.io.training_folder import CHECKPOINT, GARMENT, MODEL, NETWORK, OPTIONS, RECORD
from caphy.pipeline.ledger import Ledger
from caphy.pipeline.processes import run_shared
from caphy.pipeline.stage import Stage

AVATAR, FABRIC, PAGE = "avatar", "fabric.json", "report.html"
FABRICS, FABRIC_PAGE = (FABRIC, "fabric_upper.json", "fabric_lower.json"), "fabric.html"
FIRST = 0.6
"""Share of the training that comes before the fabric is fitted."""
SUBJECT = ("body.npz", "upper.npz", "lower.npz", "subject_body.npz", "points", "split.json", LABELLED)
"""What the registration leaves that training depends on."""
STAGES = ("train", "fabric", "collided")
"""Folders of trainings, in order."""
TRAINED = (NETWORK, GARMENT, MODEL, OPTIONS, RECORD)
"""What a training leaves that later stages depend on; a checkpoint, and what 'caphy validate' adds, is not of it."""


@dataclass(frozen=True)
class Plan:
    """What is fitted, and how; see :class:`caphy.commands.fit.Fit`."""

    scans: Path
    run: Path
    poses: tuple[Path, ...]
    parser: str | None
    layout: str
    body: str
    fabric: str
    minutes: float
    steps: int | None
    fabric_rounds: int
    fabric_scans: int
    collision_epochs: int
    hold_out: Literal["random", "unlike"]
    vgg: Path | None
    licence: str | None
    seed: int
    device: str
    processes: int

    def shared(self, share: float) -> list[str]:
        """Options of a training that gets a share of the minutes, or of the steps where these are given."""
        if self.steps is not None:
            return ["--steps", str(max(1, round(share * self.steps)))]
        return ["--minutes", f"{share * self.minutes:.6g}"]


def stages(plan: Plan, count: int, beyond: Sequence[Path] = ()) -> list[Stage]:
    """All stages for ``count`` scans, in order; seconds as one core took for 80 (docs/fit.md).

    beyond: what of the scans lies elsewhere than in their folder.
    """
    run = plan.run
    labelled = (run / SCANS, run / LABELS, run / LABELLED)
    subject = tuple(run / name for name in SUBJECT)
    seconds, timed = (60 * plan.minutes, True) if plan.steps is None else (0.3 * plan.steps, False)
    training = {"fabric": plan.fabric, "seed": plan.seed, "device": plan.device}
    fabrics = tuple(run / name for name in FABRICS)
    trained, refined, collided = (networks(run, stage) for stage in STAGES)
    body, parser = _files(plan.body), _files(plan.parser)
    validations = tuple(run / stage / kind / VALIDATION for stage in STAGES for kind in KINDS)
    chosen, layout = "its own" if parser else plan.parser, "its own" if _files(plan.layout) else plan.layout
    told = {"body": None if body else plan.body}  # of files the content counts, wherever they lie
    made = [
        Stage(
            "check", "checking the scans", lambda: check_scans(plan.scans, run, plan.parser),
            inputs=(plan.scans, *beyond), outputs=(run / SCANS, run / CHECKED),
            options={"parser": chosen}, seconds=1 + 0.13 * count,
        ),
        Stage(
            "segment", "telling skin, upper and lower garment apart",
            lambda: segment_scans(run, plan.parser, plan.layout),
            inputs=(run / SCANS, *parser, *_files(plan.layout)), outputs=labelled[1:],
            options={"parser": chosen, "layout": layout if parser else None}, seconds=2 + 0.8 * count,
        ),
        Stage(
            "body", "finding the body under the clothes", lambda: _body(plan),
            inputs=(*labelled, *body), outputs=(run / "body.npz", run / "body.json"), options=told,
            seconds=5 + 1.6 * count,
        ),
        Stage(
            "points", "splitting the scans", lambda: _points(plan),
            inputs=(*labelled, run / "body.npz", *body),
            outputs=(run / "points", run / "split.json", run / "subject_body.npz"),
            options=told | {"hold_out": plan.hold_out, "seed": plan.seed}, seconds=1 + 0.1 * count,
        ),
        Stage(
            "garments", "choosing the garments' templates", lambda: _garments(plan),
            inputs=(*labelled, run / "body.npz", run / "split.json", *body), outputs=(run / TEMPLATES,),
            whole=lambda: all((run / f"{kind}.npz").is_file() for kind in kinds(run)),
            options=told | {"fabric": plan.fabric}, seconds=220,
        ),
        Stage(
            "train", "training on physics and scans", lambda: _train(plan),
            inputs=(*subject, *plan.poses), outputs=(run / "train",), whole=lambda: _has_networks(run, "train"),
            options=training | {"budget": plan.shared(FIRST)}, seconds=FIRST * seconds, timed=timed,
        ),
        Stage(
            "fabric", "fitting the fabric to the scans", lambda: _fabric(plan),
            inputs=(*subject, *trained), outputs=(run / FABRIC,), whole=lambda: _has_models(run),
            options={"fabric": plan.fabric, "rounds": plan.fabric_rounds, "scans": plan.fabric_scans},
            seconds=30 + min(count, plan.fabric_scans) * (50 + 10 * plan.fabric_rounds), may_fail=True,
        ),
        Stage(
            "refine", "training on, under the fabric found if there is one", lambda: _refine(plan),
            inputs=(*subject, *plan.poses, *trained, *fabrics), outputs=(run / "fabric",),
            whole=lambda: _has_networks(run, "fabric"),
            options=training | {"budget": plan.shared(1 - FIRST)}, seconds=(1 - FIRST) * seconds, timed=timed,
        ),
        Stage(
            "collide", "fine-tuning against collisions of garments", lambda: _collide(plan),
            inputs=(*trained, *refined, *subject, *plan.poses), outputs=(run / "collided",),
            options={"epochs": plan.collision_epochs, "seed": plan.seed},
            seconds=0.9 * max(0.3 * count, 25) * plan.collision_epochs,
            may_fail=True,
        ),
        Stage(
            "export", "writing the avatar", lambda: _export(plan),
            inputs=(*trained, *refined, *collided, run / "subject_body.npz", *validations), outputs=(run / AVATAR,),
            options={"licence": plan.licence}, seconds=5,
        ),
        Stage(
            "evaluate", "holding it against the scans left out of training", lambda: _evaluate(plan),
            inputs=(
                *labelled, *subject, run / FABRIC, run / TEMPLATES, *trained, *refined, *collided, run / "rows",
                *_files(plan.vgg),
            ),
            outputs=(run / "evaluation.json", run / "evaluation.txt", run / "evaluation"),
            options={"vgg": plan.vgg is not None}, seconds=5 + 0.9 * count, may_fail=True,
        ),
    ]  # fmt: skip
    shown = tuple(run / name for name in (CHECKED, "body.json", FABRIC, "evaluation.json", TEMPLATES, AVATAR))
    records = tuple(Ledger(run).record(stage) for stage in made)  # what stages took, and why they failed
    report = Stage(
        "report", "writing the page", lambda: _report(plan),
        inputs=(*labelled, *subject, *shown, *records), outputs=(run / PAGE,), seconds=3, may_fail=True,
        of_all=True,
    )  # fmt: skip
    return [*made, report]


def networks(run: Path, stage: str) -> tuple[Path, ...]:
    """What a stage's trainings leave to those after it."""
    return tuple(run / stage / kind / name for kind in KINDS for name in TRAINED)


def kinds(run: Path) -> list[str]:
    """The garments that the scans show, innermost first."""
    return list(reversed(read(run, LABELLED)["kinds"]))


def _command(name: str, *arguments: str | Path, processes: int = 1) -> None:
    """Run a command as a user would; its line goes into the log."""
    words = [str(argument) for argument in arguments]
    print(f"$ {shlex.join(['caphy', name.replace('_', '-'), *words])}", flush=True)
    if processes > 1:
        status = run_shared([name, *words], processes)
    else:
        status = importlib.import_module(f"caphy.commands.{name}").main(words)
    if status == 130:  # 'caphy train' ends so when it is interrupted
        raise KeyboardInterrupt
    if status:
        raise CaphyError(f"caphy {name} ended with status {status}; see the stage's log")


def _files(*given: str | Path | None) -> tuple[Path, ...]:
    """Those options that are files."""
    return tuple(path for path in (Path(value) for value in given if value) if path.is_file())


def _labelled(plan: Plan) -> list[str | Path]:
    return [plan.run / SCANS, "-o", plan.run, "--labels", plan.run / LABELS]


def _body(plan: Plan) -> None:
    _command("register", "body", *_labelled(plan), "--body", plan.body)


def _garments(plan: Plan) -> None:
    worn = read(plan.run, LABELLED)["kinds"]
    for kind in {"upper", "lower"} - set(worn):
        (plan.run / f"{kind}.npz").unlink(missing_ok=True)
    options = ["--body", plan.body, "--fabric", plan.fabric, "--garments", *worn]
    _command("register", "garments", *_labelled(plan), *options)


def _points(plan: Plan) -> None:
    if plan.hold_out == "unlike":
        _split_unlike(plan)
    _command("register", "points", *_labelled(plan), "--body", plan.body, "--seed", str(plan.seed))


def _split_unlike(plan: Plan) -> None:
    """Hold out the poses least like the rest; 'caphy register points' keeps a split that is there."""
    import json

    from caphy.evaluate.classes import unlike_split
    from caphy.garment.template import read_npz
    from caphy.io.places import write_text
    from caphy.register.points import SPLIT

    fit = read_npz(plan.run / "body.npz")
    split = unlike_split([str(name) for name in fit["names"]], fit["poses"])
    write_text(plan.run / SPLIT, json.dumps(split, indent=1))


def _train(plan: Plan) -> None:
    for kind in kinds(plan.run):
        begun: list[str | Path] = ["--transfer", "default"] if _like_the_default(plan, kind) else []
        _train_one(plan, kind, plan.run / "train" / kind, FIRST, ["--fabric", plan.fabric, *begun])


def _like_the_default(plan: Plan, kind: str) -> bool:
    """Whether the default avatar wears anything like a garment, so that its training need not begin from nothing."""
    from caphy.body.model import BodyModel
    from caphy.garment.template import Garment
    from caphy.io.bundled import bundled
    from caphy.training.initial import read_likeness

    joints = BodyModel.load(plan.run / "subject_body.npz").joints
    try:
        read_likeness(bundled(Path("default")), Garment.load(plan.run / f"{kind}.npz"), joints)
    except CaphyError as error:
        print(f"{error}: the {kind} garment is trained from nothing")
        return False
    return True


def _train_one(plan: Plan, kind: str, folder: Path, share: float, physics: Sequence[str | Path]) -> None:
    """Train one garment, or what is missing of it, with a share of the budget."""
    resume = ["--resume"] if (folder / CHECKPOINT).is_file() else []
    options = [*plan.shared(share / len(kinds(plan.run))), "--seed", str(plan.seed), "--device", plan.device]
    where = [plan.run / f"{kind}.npz", *plan.poses, "-o", folder, "--scans", plan.run]
    _command("train", *where, *physics, *options, *resume, processes=plan.processes)


def _has_networks(run: Path, stage: str) -> bool:
    """Whether a stage's networks of all garments are there."""
    return all((run / stage / kind / NETWORK).is_file() for kind in kinds(run))


def _has_models(run: Path) -> bool:
    """Whether fabrics were fitted, and the models of all are there."""
    told = read(run, FABRIC)
    fitted = told.get("garments") if isinstance(told, dict) else None
    if not fitted or not isinstance(fitted, dict):
        return False
    names = [each.get("model_file") if isinstance(each, dict) else None for each in fitted.values()]
    return all(isinstance(name, str) and (run / name).is_file() for name in names)


def _fabric(plan: Plan) -> None:
    if (plan.run / FABRIC).is_file() and _has_models(plan.run):  # else it would have been removed
        print(f"{plan.run / FABRIC} is there already, and of the same input; it is kept")
        return
    for name in (*FABRICS, FABRIC_PAGE):  # what an earlier fit could fit, this one may not
        (plan.run / name).unlink(missing_ok=True)
    try:
        budget = ["--rounds", str(plan.fabric_rounds), "--scans", str(plan.fabric_scans)]
        _command("fabric", plan.run, "--fabric", plan.fabric, *budget)
    except CaphyError:
        if not (plan.run / FABRIC).is_file():  # else one garment's fabric was found, and the other's was told of
            raise


def _refine(plan: Plan) -> None:
    """Networks trained on under the fabric that was found, or under the first one where none was."""
    found = read(plan.run, FABRIC).get("garments", {})
    for kind in kinds(plan.run):
        model = ["--model", plan.run / found[kind]["model_file"]] if kind in found else ["--fabric", plan.fabric]
        before = ["--init", plan.run / "train" / kind]
        _train_one(plan, kind, plan.run / "fabric" / kind, 1 - FIRST, [*before, *model])


def _collide(plan: Plan) -> None:
    worn, folder = kinds(plan.run), plan.run / "collided"
    folder.mkdir(parents=True, exist_ok=True)
    if len(worn) < 2:
        print(f"only a {worn[0]} garment: there is nothing for it to collide with")
        return
    resume = ["--resume"] if (folder / CHECKPOINT).is_file() else []
    budget = ["--epochs", str(plan.collision_epochs), "--seed", str(plan.seed)]
    moved: list[str | Path] = ["--poses", *plan.poses] if plan.poses else []
    try:
        _command("collide", *networks_of(plan.run, ("fabric", "train")), "-o", folder, *moved, *budget, *resume)
    except CaphyError:
        for kind in worn:  # of epochs before: the avatar is made without; the checkpoint goes on from them
            (folder / kind / NETWORK).unlink(missing_ok=True)
        raise


def final(run: Path) -> list[Path]:
    """The folders of the networks that the avatar is made of, innermost garment first: the last that there are."""
    from caphy.evaluate.rows import LAST

    return networks_of(run, LAST)


def networks_of(run: Path, stages: Sequence[str]) -> list[Path]:
    """Folders of every garment's network of the first of ``stages`` that has them all.

    Raises:
        CaphyError: none has.
    """
    worn = kinds(run)
    for stage in stages:
        folders = [run / stage / kind for kind in worn]
        if all((folder / NETWORK).is_file() for folder in folders):
            return folders
    raise CaphyError(f"{run}: holds no trained networks of {' and '.join(worn)}; run 'caphy fit' again")


def _export(plan: Plan) -> None:
    from export.avatar import BODY_LICENCE

    trained: Sequence[Path] = final(plan.run)
    licence = plan.licence or f"{BODY_LICENCE}; shape and garments fitted to scans"
    body = plan.run / "subject_body.npz"
    _command("export", *trained, "-o", plan.run / AVATAR, "--body", body, "--licence", licence)


def _evaluate(plan: Plan) -> None:
    vgg: list[str | Path] = [] if plan.vgg is None else ["--vgg", plan.vgg]
    _command("evaluate", *_labelled(plan), *vgg)


def _report(plan: Plan) -> None:
    from caphy.commands.fit_report import write_report

    print(write_report(plan.run))
