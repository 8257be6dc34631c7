"""A training that goes on from another under a changed physics, as the rounds of parameter optimisation do."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.io.places import write_text
from caphy.training.checkpoint import NAME
from caphy.training.loop import METRICS, Schedule, Trainer

KEPT = ("garment.npz", "run.json", "options.json")
"""What a training's folder holds besides its network and its physics."""


def onward(
    trainer: Trainer, model: Model, steps: int, folder: Path, seed: int = 0, learning_rate: float = 5e-4
) -> Trainer:
    """A trainer of ``steps`` more steps on the network of ``trainer`` under another ``model``, ready to ``run()``.

    Motions, scans and their weight stay; windows are drawn by ``seed``; the optimizer and the coordinates that it works
    in start anew, for these depend on the stiffness. The network is the same object, trained in place. ``folder`` gets
    all that 'caphy train' would write, so it can be exported, validated, and opened with
    :func:`caphy.commands.train.reopen`. Where it holds what the same call has left, it goes on from that: after a
    kill, it ends as it would have.
    """
    trainer.learner.fold(trainer.network)
    old = trainer.objective.potential
    potential = Potential(model, old.cloth, old.dtype, old.device)
    objective = trainer.objective.under(potential)
    scans = None if trainer.scans is None else trainer.scans.under(potential)
    schedule = Schedule(steps, None, trainer.schedule.streams, learning_rate)
    motions, held_out = trainer.track.motions, trainer.held_out
    after = Trainer(folder, trainer.network, objective, motions, held_out, schedule, seed, trainer.say, scans)
    if _begun(trainer.folder, folder, model, steps, seed):
        after.resume()
        return after
    if after.rank == 0:
        for name in (NAME, METRICS):
            (folder / name).unlink(missing_ok=True)
        _record(trainer.folder, folder, model, steps, seed)
    return after


def _told(source: Path, steps: int, seed: int) -> dict[str, Any]:
    return {"init": {"run": source.resolve().name}, "minutes": None, "steps": steps, "seed": seed}


def _begun(source: Path, folder: Path, model: Model, steps: int, seed: int) -> bool:
    """Whether a folder holds what the same call has left; other trainings may have gone on there as well."""
    if not all((folder / name).is_file() for name in (NAME, "model.json", "run.json")):
        return False
    record, own = json.loads((folder / "run.json").read_text()), _told(source, steps, seed)
    return Model.load(folder / "model.json") == model and {name: record.get(name) for name in own} == own


def _record(source: Path, folder: Path, model: Model, steps: int, seed: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in KEPT:
        if source != folder and (source / name).is_file():
            shutil.copyfile(source / name, folder / name)
    if (folder / "run.json").is_file():
        record = json.loads((folder / "run.json").read_text())
        record |= _told(source, steps, seed)
        write_text(folder / "run.json", json.dumps(record, indent=2) + "\n")
    write_text(folder / "model.json", model.to_json() + "\n")
