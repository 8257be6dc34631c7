"""``caphy collide``: fine-tune garments worn together until they stop passing through each other."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from caphy.commands.begun import copied, exporting, interrupted
from caphy.commands.output import OUTPUT
from caphy.commands.seed import require_seed
from caphy.errors import CaphyError
from caphy.io.places import write_text
from caphy.io.training_folder import CHECKPOINT, GARMENT, MODEL, OPTIONS, RECORD

if TYPE_CHECKING:
    from caphy.training.collide import Collider
    from caphy.training.loop import Trainer


COLLIDED = "fine_tuned_on_collisions"
"""Where a record tells of each fine-tuning, and so the avatar that is made of it."""


@dataclass(frozen=True)
class Collide:
    """Fine-tune the networks of garments worn one over the other, two or more, until they keep out of each other."""

    trainings: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that 'caphy train' wrote, on the same body, motions and scans, the innermost garment first; a garment
    that was supervised as hidden by another comes before it in any case."""
    output: Annotated[Path, OUTPUT]
    """Folder for the fine-tuned trainings, each under its own folder's name."""
    poses: tuple[Path, ...] = ()
    """The motions that the trainings are on, pose files or folders, where they lie elsewhere by now."""
    epochs: int = 10
    """Passes through the scans' poses, each with as many steps on random poses."""
    seed: int = 0
    """What is drawn follows from it alone."""
    resume: bool = False
    """Go on from the folder's checkpoint."""


def main(arguments: list[str]) -> int | None:
    """Entry point of ``caphy collide``."""
    options = tyro.cli(Collide, args=arguments, prog="caphy collide", config=(tyro.conf.OmitArgPrefixes,))
    if options.epochs < 1:
        raise CaphyError(f"--epochs must be positive, got {options.epochs}")
    require_seed(options.seed)
    if (options.output / CHECKPOINT).exists() and not options.resume:
        raise CaphyError(f"{options.output} holds a fine-tuning already: add --resume, or give another folder with -o")
    collider = prepare(options)
    if options.resume:
        collider.resume()
    try:
        collider.run()
    except KeyboardInterrupt:
        print(interrupted(options.output))
        return 130
    made = [options.output / name for name in collider.names]
    print(f"wrote {', '.join(map(str, made))}\nnext: {exporting(options.output.name, *made)}")
    return 0


def prepare(options: Collide) -> Collider:
    """A fine-tuning ready to run, and folders with all that an export needs beside the networks to come; where it is to
    be resumed they are there, and may be of other networks, which the checkpoint tells."""
    from caphy.commands.train import reopen
    from caphy.training.collide import Collider

    names = [folder.resolve().name for folder in options.trainings]
    if len(set(names)) < len(names):
        raise CaphyError(f"the folders' own names must differ, got {', '.join(names)}")
    for folder, name in zip(options.trainings, names, strict=True):
        if folder.resolve() == (options.output / name).resolve():
            raise CaphyError(f"{options.output}: {folder} lies there, which is only read; give another folder with -o")
    trainers = [reopen(folder, options.poses) for folder in options.trainings]
    order = sorted(range(len(names)), key=lambda i: not _hidden(trainers[i]))
    folders, names = [options.trainings[i] for i in order], [names[i] for i in order]
    collider = Collider(options.output, names, [trainers[i] for i in order], options.epochs, options.seed)
    for folder in () if options.resume else folders:
        own = options.output / folder.resolve().name
        own.mkdir(parents=True, exist_ok=True)
        for kept in (GARMENT, MODEL):
            shutil.copyfile(folder / kept, own / kept)
        write_text(own / RECORD, _recorded(folder / RECORD, names, options))
        write_text(own / OPTIONS, copied(folder, own))
    print(f"from the inside out: {', '.join(names)}; {collider.schedule.steps} steps")
    return collider


def _recorded(path: Path, names: list[str], options: Collide) -> str:
    """A training's record with this fine-tuning in it, after earlier ones."""
    try:
        record = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise CaphyError(f"{path}: must be as 'caphy train' wrote it, and cannot be read ({error})") from error
    now = {"from_the_inside_out": names, "epochs": options.epochs, "seed": options.seed}
    return json.dumps({**record, COLLIDED: [*record.get(COLLIDED, []), now]}, indent=2) + "\n"


def _hidden(trainer: Trainer) -> bool:
    """Whether scans showed another garment over this one."""
    return trainer.scans is not None and any(target.over is not None for target in trainer.scans.loss.targets)
