"""A training that goes on from another under a changed physics, as the rounds of parameter optimisation do."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from caphy.commands.begun import copied
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.io.places import write_text
from caphy.io.training_folder import CHECKPOINT, GARMENT, METRICS, MODEL, OPTIONS, RECORD
from caphy.kept import digest
from caphy.training.loop import Schedule, Trainer


def onward(
    trainer: Trainer, model: Model, steps: int, folder: Path, seed: int = 0, learning_rate: float = 5e-4
) -> Trainer:
    """A trainer of ``steps`` more steps on the network of ``trainer`` under another ``model``, ready to ``run()``.

    Motions, scans and their weight stay; windows are drawn by ``seed``; the optimizer and the coordinates that it works
    in start anew, for these depend on the stiffness. The network is the same object, trained in place. ``folder`` gets
    all that 'caphy train' would write, so it can be exported, validated, and opened with
    :func:`caphy.commands.train.reopen`. Where it holds what the same call on the same network has left, it goes on
    from that: after a kill, it ends as it would have.

    Raises:
        CaphyError: the folder holds a training that no call of this began.
    """
    trainer.learner.fold(trainer.network)
    old = trainer.objective.potential
    potential = Potential(model, old.cloth, old.dtype, old.device)
    objective = trainer.objective.under(potential)
    scans = None if trainer.scans is None else trainer.scans.under(potential)
    schedule = Schedule(steps, None, trainer.schedule.streams, learning_rate)
    motions, held_out = trainer.track.motions, trainer.held_out
    after = Trainer(folder, trainer.network, objective, motions, held_out, schedule, seed, trainer.say, scans)
    own = _own(trainer, folder, steps, seed, learning_rate)
    if trainer.folder != folder:
        require_own(folder)
    if _begun(folder, model, own):
        after.resume()
        return after
    if after.rank == 0:
        for name in (CHECKPOINT, METRICS):
            (folder / name).unlink(missing_ok=True)
        _record(trainer.folder, folder, model, own)
    return after


def _own(trainer: Trainer, folder: Path, steps: int, seed: int, learning_rate: float) -> dict[str, Any]:
    """What the record says of such a training, by which it is known again. Of one that goes on in its own folder the
    network it began with is gone."""
    init = {"run": trainer.folder.resolve().name}
    if trainer.folder != folder:
        init["network_digest"] = digest([each.cpu().numpy() for each in trainer.network.state_dict().values()])
    return {"init": init, "minutes": None, "steps": steps, "seed": seed, _RATE: learning_rate}


_RATE = "learning_rate"  # of no other record


def require_own(folder: Path) -> None:
    """Raise CaphyError where :func:`onward` would overwrite another training, one whose record is lost or damaged
    included."""
    if not (folder / CHECKPOINT).is_file():
        return
    try:
        own = _RATE in json.loads((folder / RECORD).read_text())
    except (OSError, ValueError):
        own = False
    if not own:
        raise CaphyError(
            f"{folder}: holds a training that was not begun so, which would be lost; move it to another folder"
        )


def _begun(folder: Path, model: Model, own: dict[str, Any]) -> bool:
    """Whether a folder holds what the same call has left; other trainings may have gone on there as well."""
    if not all((folder / name).is_file() for name in (CHECKPOINT, MODEL, RECORD)):
        return False
    record = json.loads((folder / RECORD).read_text())
    return Model.load(folder / MODEL) == model and {name: record.get(name) for name in own} == own


def _record(source: Path, folder: Path, model: Model, own: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if source != folder:
        for name in (GARMENT, RECORD):
            if (source / name).is_file():
                shutil.copyfile(source / name, folder / name)
        if (source / OPTIONS).is_file():
            write_text(folder / OPTIONS, copied(source, folder))
    if (folder / RECORD).is_file():
        record = json.loads((folder / RECORD).read_text()) | own
        write_text(folder / RECORD, json.dumps(record, indent=2) + "\n")
    write_text(folder / MODEL, model.to_json() + "\n")
