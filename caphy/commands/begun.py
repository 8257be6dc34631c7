"""What a training was begun with, beside its network: for the export and readers, and so that it goes on alike."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from caphy.commands.following import following
from caphy.errors import CaphyError
from caphy.evaluate.learnt_from import CONTENTS, INIT_SCANS, SCANS_DIGEST, learnt_from
from caphy.io.bundled import OURS, path_of, recorded
from caphy.io.places import write_text
from caphy.io.training_folder import CHECKPOINT, GARMENT, MODEL, OPTIONS, RECORD

if TYPE_CHECKING:
    from caphy.commands.train import Train
    from caphy.effects.model import Model
    from caphy.garment.template import Garment
    from caphy.io.poses import PoseSequence
    from caphy.training.initial import Initial


def option(kind: Any, value: Any, folder: Path) -> Any:
    """An option read from a folder's JSON, where paths are text (:func:`caphy.io.bundled.path_of`) and tuples lists."""
    if isinstance(value, list):
        return tuple(option(kind, one, folder) for one in value)
    return path_of(value, folder) if isinstance(value, str) and "Path" in str(kind) else value


def own_body(run: Path) -> Path | None:
    """The body that a training in a folder was on, where it was told one.

    Raises:
        CaphyError: there is no training in it.
    """
    try:
        given = json.loads((run / OPTIONS).read_text()).get("body")
    except (OSError, ValueError) as error:
        raise CaphyError(f"{run}: is not a folder that 'caphy train' wrote: {error}") from error
    return None if given is None else option(Path, given, run.resolve())


def exporting(name: str, *runs: Path) -> str:
    """What makes an avatar of a name of trainings; the licence of a body of one's own only its owner can tell."""
    body = own_body(runs[0])
    own = () if body is None or recorded(body) else ("--body", body, "--licence", "the licence of this body")
    return following("export", *runs, *own, "-o", f"avatars/{name}")


def interrupted(folder: Path) -> str:
    """What is left of a training that was stopped by hand, in words."""
    if (folder / CHECKPOINT).exists():
        return "interrupted; go on from the last checkpoint with --resume"
    return "interrupted before the first checkpoint; nothing was kept, so begin again"


def told(options: Train) -> dict[str, Any]:
    """Options ready for JSON. Where the folder lies in the run that ``--scans`` names, paths within that run are
    relative to the folder, so that the run may be moved; what comes with caphy is told by name."""
    folder, run = options.output.resolve(), None if options.scans is None else options.scans.resolve()

    def plain(value: Any) -> Any:
        if isinstance(value, tuple):
            return [plain(one) for one in value]
        if not isinstance(value, Path):
            return value
        if (ours := recorded(value)) is not None:
            return ours
        within = run is not None and folder.is_relative_to(run) and value.resolve().is_relative_to(run)
        return os.path.relpath(value.resolve(), folder) if within else str(value.resolve())

    return {field.name: plain(getattr(options, field.name)) for field in fields(options)}


def copied(folder: Path, to: Path) -> str:
    """The options of the training in a folder, as they read in another: paths relative to the first are of the second
    where that lies in the same run, and whole where it does not."""
    from caphy.commands.train import Train

    folder, to = folder.resolve(), to.resolve()
    given = json.loads((folder / OPTIONS).read_text())
    run = Path(os.path.normpath(folder / given["scans"])) if given.get("scans") else None

    def moved(value: Any) -> Any:
        if isinstance(value, list):
            return [moved(one) for one in value]
        if not isinstance(value, str) or Path(value).is_absolute() or value.startswith(OURS):
            return value
        path = os.path.normpath(folder / value)
        return os.path.relpath(path, to) if run is not None and to.is_relative_to(run) else path

    paths = {field.name for field in fields(Train) if "Path" in str(field.type)}
    return json.dumps({name: moved(value) if name in paths else value for name, value in given.items()}, indent=2)


def contents(options: Train, trained: Sequence[PoseSequence]) -> dict[str, str]:
    """Digests of what options name by path alone: motions, the code of own effects, the body, the points of scans."""
    from caphy.body.model import BodyModel
    from caphy.commands.supervision import templates
    from caphy.kept import code, digest
    from caphy.register.points import read_points

    found = {"motions": _motions(trained), "effect files": digest(code(options.effect_file))}
    if options.body is not None:
        found["arrays of the body"] = digest(BodyModel.load(options.body))
    if options.scans is not None:
        found["scans"] = digest(read_points(options.scans, "train"))
        found["templates of the run"] = digest(templates(options.scans))  # tell what hides what, and what is mirrored
    return found


def _motions(trained: Sequence[PoseSequence]) -> str:
    from caphy.io.poses.parts import file_of
    from caphy.kept import digest

    return digest([(clip.poses, clip.transl, clip.fps) for clip in trained if Path(file_of(clip.source)).is_file()])


def as_long(options: Train) -> Train:
    """The options of a training that is resumed, to go on for as long as it was begun for unless they say otherwise."""
    if not options.resume or options.steps is not None or options.minutes is not None:
        return options
    try:
        before = json.loads((options.output / OPTIONS).read_text())
    except (OSError, ValueError):
        return options  # nothing was begun there, which the checkpoint's absence tells
    return replace(options, steps=before.get("steps"), minutes=before.get("minutes"))


def require_same_motions(folder: Path, trained: Sequence[PoseSequence]) -> None:
    """Raise CaphyError unless the training in a folder was on these motions."""
    was = json.loads((folder / OPTIONS).read_text()).get(CONTENTS, {}).get("motions")
    if was is not None and was != _motions(trained):
        raise CaphyError(
            f"{folder}: was trained on other motions than these {len(trained)}; give the same with --poses, in the "
            "same order, wherever they lie"
        )


def require_same(options: Train, garment: Garment, model: Model, trained: Sequence[PoseSequence]) -> None:
    """Raise CaphyError where a training would go on otherwise than it began: its record would be wrong of one part."""
    try:
        before = json.loads((options.output / OPTIONS).read_text())
        clips = json.loads((options.output / RECORD).read_text())["trained_on"]
        what = _parted(options, garment, model, trained, before, clips)
    except (OSError, ValueError, KeyError, CaphyError):
        return  # nothing was begun there, which the checkpoint's absence tells, or its record is damaged and made anew
    if what:
        raise CaphyError(f"{options.output}: was begun {what}; go on with the same, or begin anew in another folder")


def _parted(
    options: Train, garment: Garment, model: Model, trained: Sequence[PoseSequence], before: dict, clips: list[str]
) -> str:
    """With what else a training was begun, in words; empty where all is the same."""
    from caphy.body.bundled import default_body_path
    from caphy.effects.model import Model
    from caphy.garment.template import REALS, Garment

    now, folder = told(options), options.output.resolve()
    may = {"resume", "output", "minutes", "steps", "device", "poses", "garment", "effect_file"}
    for field in fields(options):
        if field.name in before and field.name not in may:
            was, given = (option(field.type, values[field.name], folder) for values in (before, now))
            if field.name == "body":
                was, given = (default_body_path() if body is None else body for body in (was, given))
            if was != given and not (field.name == "worn" and was is None):
                return f"with --{field.name.replace('_', '-')} {was}, not {given}"
    worn, names = Garment.load(options.output / GARMENT), [Path(clip.source).name for clip in trained]
    if worn.vertices.shape != garment.vertices.shape or not (worn.faces == garment.faces).all():
        return f"on another garment, of {len(worn.vertices)} vertices"
    for name, what in (("vertices", "another shape"), *((name, f"other {name}") for name in REALS)):
        if not np.allclose(getattr(worn, name), getattr(garment, name), rtol=0, atol=1e-6):
            return f"on a garment of the same mesh and {what.replace('_', ' ')}"
    was, given = before.get(CONTENTS, {}), contents(options, trained)
    same = len(clips) == len(names) and was.get("motions") == given["motions"] and "motions" in was
    if clips != names and not same:  # files may have been renamed since
        one = next((name for name in (*clips, *names) if name not in clips or name not in names), "in another order")
        return f"on other motions, {len(clips)} in all, not {len(names)} ({one})"
    if Model.load(options.output / MODEL) != model:
        return f"under another model, kept in {options.output / MODEL}"
    other = [name for name in was if name in given and was[name] != given[name]]
    return f"with other {' and '.join(other)}, which have changed since" if other else ""


def write_record(
    options: Train, shape: tuple[float, ...], initial: Initial | None, garment: Garment, model: Model, fps: float,
    trained: Sequence[PoseSequence], held_out: Sequence[PoseSequence],
) -> None:  # fmt: skip
    """Put beside the network what the export needs, and what a reader wants to know of its making."""
    from caphy.io.poses.parts import placed

    garment.save(options.output / GARMENT)
    write_text(options.output / MODEL, model.to_json() + "\n")
    read, begun = contents(options, trained), options.init or options.transfer
    write_text(options.output / OPTIONS, json.dumps({**told(options), CONTENTS: read}, indent=2))
    record = {
        "format": "caphy-run-1",
        "fps": fps,
        "seed": options.seed,
        "body": None if options.body is None else recorded(options.body) or str(options.body),
        "betas": list(shape),
        "init": None if initial is None else dict(initial.record),
        "fabric": options.fabric,
        "minutes": options.minutes,
        "steps": options.steps,
        "trained_on": [Path(clip.source).name for clip in trained],
        "held_out": [Path(clip.source).name for clip in held_out],
        "scans": None if options.scans is None else options.scans.resolve().name,
        SCANS_DIGEST: read.get("scans"),
        INIT_SCANS: None if begun is None else sorted(set(learnt_from(begun))),
        "lambda_3d": options.lambda_3d,
        "physics": options.physics,
        "held_out_paths": [placed(clip.source) for clip in held_out],
    }
    write_text(options.output / RECORD, json.dumps(record, indent=2) + "\n")
