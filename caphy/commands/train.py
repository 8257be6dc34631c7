"""``caphy train``: train a garment network with physics losses, supervised by scans where there are any."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from caphy.commands.begun import (
    as_long,
    exporting,
    interrupted,
    option,
    require_same,
    require_same_motions,
    write_record,
)
from caphy.commands.output import OUTPUT
from caphy.commands.seed import require_seed
from caphy.commands.training_options import require_device, require_positive
from caphy.errors import CaphyError
from caphy.io.bundled import bundled
from caphy.io.places import writable_folder
from caphy.io.training_folder import CHECKPOINT, GARMENT, MODEL, OPTIONS

if TYPE_CHECKING:
    from caphy.effects.model import Model
    from caphy.garment.template import Garment
    from caphy.io.poses import PoseSequence
    from caphy.network.garment_network import GarmentNetwork
    from caphy.training.initial import Initial
    from caphy.training.loop import Trainer
    from caphy.training.objective import Objective
    from caphy.training.scans import Scans

FPS = 30.0
"""Frame rate that networks run at [Hz]."""

PROCEDURAL = tuple(range(12))
"""Seeds of the motions that there are where none are given; every sixth is held out."""

PROCEDURAL_SECONDS = 20.0
"""How long each of them is [s]."""


BODY_EFFECTS = ("body_contact", "attachment")
"""What keeps a garment off its body, and on it."""

MADE_UP = 100
"""First seed of the motions of --made-up."""


@dataclass(frozen=True)
class Train:
    """Train a garment network on motions with physics losses.

    Run it with torchrun to share the work among processes."""

    garment: tyro.conf.Positional[Path]
    """Garment npz, as 'caphy garment make' writes it, or "tshirt" or "trousers" for the bundled ones."""
    poses: tyro.conf.Positional[tuple[Path, ...]]
    """Pose files, or folders of them; without any, motions are made from seeds."""
    output: Annotated[Path, OUTPUT]
    """Folder of this training."""
    init: Path | None = None
    """Go on from this network instead of from nothing: an avatar's folder, "default" for the bundled one, or the
    folder of a training."""
    transfer: Path | None = None
    """Begin as the most alike garment of this avatar ("default" for the bundled one), whatever mesh, cut and body it
    has, instead of from nothing."""
    made_up: int = 0
    """Motions of 20 s made from seeds to train on besides the files: arms go where few recordings have them."""
    held_out: tuple[Path, ...] = ()
    """Pose files or folders to validate on; without any, every sixth file, or of fewer the end of the longest clip."""
    body: Path | None = None
    """Body npz in the SMPL-X format, or "medium" or "fine" for the bundled body; subject_body.npz of --scans, or medium
    unless given."""
    betas: tuple[float, ...] = ()
    """Body shape that the garment was made on; that of --init unless given."""
    fabric: str | None = None
    """A measured fabric; the model of --init unless given, or SNUG's cotton."""
    model: Path | None = None
    """Physics model as JSON instead of a fabric."""
    effect_file: tuple[Path, ...] = ()
    """Python files with effects of your own that the model uses."""
    minutes: float | None = None
    """How long to train; 45 unless --steps is given."""
    steps: int | None = None
    """How many steps to train."""
    scans: Path | None = None
    """Folder with points/ and split.json ('caphy register points') whose training scans supervise the garment."""
    worn: Literal["upper", "lower"] | None = None
    """Which points of the scans are the garment's; told from its file's name or its family unless given."""
    outermost: Literal["upper", "lower"] | None = None
    """Which garment is worn over the other; what the scans show, if the folder holds both, or upper."""
    lambda_3d: float | None = None
    """Weight of the squared distances from the scans [J/m^2]; 3000 unless given."""
    physics: bool = True
    """Without it the scans alone are learnt, for comparison."""
    seed: int = 0
    """What is drawn follows from it alone."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    resume: bool = False
    """Go on from the folder's checkpoint."""


def main(arguments: list[str]) -> int | None:
    """Entry point of ``caphy train``."""
    options = tyro.cli(Train, args=arguments, prog="caphy train", config=(tyro.conf.OmitArgPrefixes,))
    _check(options)
    writable_folder(options.output)
    import torch.distributed as dist

    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        # What the processes agree on besides gradients lies on the CPU, which nccl does not serve.
        dist.init_process_group("cpu:gloo,cuda:nccl" if options.device == "cuda" else "gloo")
    status = _run(options)
    if dist.is_initialized():
        # All is written. Gloo's threads may abort a process whose interpreter or group is taken down in order.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


def _run(options: Train) -> int:
    trainer = prepare(options)
    if trainer.done:
        if not trainer.written:  # removed by hand; the checkpoint has it
            trainer.save()
        if trainer.rank == 0:
            print(f"{options.output} has had {trainer.progress.step} steps already; for more give --steps or --minutes")
        return 0
    try:
        trainer.run()
    except KeyboardInterrupt:
        trainer.say(interrupted(options.output))
        return 130
    if trainer.rank == 0:
        print(f"wrote {options.output}: network, checkpoint, metrics.jsonl")
        print(f"next: {exporting(options.output.name, options.output)}")
    return 0


def _check(options: Train) -> None:
    if options.fabric and options.model:
        raise CaphyError("give either --fabric or --model, not both")
    if options.init and options.transfer:
        raise CaphyError("give either --init, to go on with a network, or --transfer, to begin as another's, not both")
    require_seed(options.seed)
    if options.made_up < 0:
        raise CaphyError(f"--made-up must not be negative, got {options.made_up}")
    if not options.physics and options.scans is None:
        raise CaphyError("--no-physics needs --scans: there is nothing else to learn from")
    if options.scans is None and (options.worn or options.outermost or options.lambda_3d is not None):
        raise CaphyError("--worn, --outermost and --lambda-3d go with --scans")
    require_positive(options, "minutes", "steps", "lambda_3d")
    if (options.output / CHECKPOINT).exists() and not options.resume:
        raise CaphyError(f"{options.output} holds a training already: add --resume, or give another folder with -o")


def _take_device(device: str) -> None:
    """Use a GPU, where one is asked for; of several processes on one machine each takes its own."""
    import torch

    process = int(os.environ.get("LOCAL_RANK", "0"))
    require_device(device, process)
    if device != "cpu":
        torch.cuda.set_device(process)


def _garment(path: Path) -> Garment:
    """A garment that can be exported in the end."""
    from caphy.garment.template import Garment
    from caphy.io.bundle import require_garment_name

    garment = Garment.load(path)
    require_garment_name(garment.name, str(path), "make it again with 'caphy garment from-mesh --name'")
    return garment


def prepare(options: Train, record: bool = True) -> Trainer:
    """A trainer ready to run, and its folder with garment, model and a record of what is trained."""
    import numpy as np
    import torch

    from caphy.body.bundled import default_body
    from caphy.body.model import BodyModel
    from caphy.commands.body import tell_other_body
    from caphy.effects.cloth import Cloth
    from caphy.effects.own import use_file
    from caphy.effects.potential import Potential
    from caphy.network.garment_network import GarmentNetwork
    from caphy.training.initial import read_initial, read_likeness
    from caphy.training.loop import Schedule, Trainer
    from caphy.training.motions import Motions, varied
    from caphy.training.objective import Objective
    from caphy.training.validate import SHORTEST

    _take_device(options.device)
    torch.manual_seed(options.seed)
    for file in options.effect_file:
        use_file(file)
    options = as_long(_found(options))
    garment = _garment(options.garment)
    options = _with_worn(options, garment)
    initial = None if options.init is None else read_initial(options.init, garment)
    model, shape = _model(options, initial), options.betas or (initial.betas if initial else ())
    body = default_body() if options.body is None else BodyModel.load(options.body)
    betas = np.array(shape) if shape else None
    joints = body.rest(betas)[1]
    if options.transfer is not None:
        initial = read_likeness(options.transfer, garment, joints)
    if initial is None:
        network = GarmentNetwork(garment.vertices, garment.weights, joints, fps=FPS)
    else:
        network = initial.network
        initial.require_joints(joints)
    network, fps = network.to(options.device), network.fps
    trained, held_out = _clips(options) if record else _same_clips(options)
    motions = Motions.of([v for clip in trained for v in varied(clip, fps)], body, network.driving, fps, betas)
    long = [clip for clip in (clip.resample(fps) for clip in held_out) if len(clip) >= SHORTEST]
    unseen = Motions.of(long, body, network.driving, fps, betas) if long else None
    potential = Potential(model, Cloth.of(garment, model.density), torch.float32, options.device)
    objective = Objective(potential, body, network.template, network.weights, fps, betas)
    minutes = 45.0 if options.minutes is None and options.steps is None else options.minutes
    schedule, scans = Schedule(options.steps, minutes), _scans(options, objective, network)
    trainer = Trainer(options.output, network, objective, motions, unseen, schedule, options.seed, scans=scans)
    if options.resume and record:
        require_same(options, garment, model, trained)
        trainer.resume()
    if trainer.rank == 0 and record and not trainer.done:
        tell_other_body(garment, joints)
        write_record(options, shape, initial, garment, model, fps, trained, held_out)
        _tell(trainer, garment, initial, trained, held_out)
    return trainer


def _tell(
    trainer: Trainer, garment: Garment, initial: Initial | None, trained: list[PoseSequence],
    held_out: list[PoseSequence],
) -> None:  # fmt: skip
    from caphy.training.blind_spots import blind_spots
    from caphy.training.mirrored import MIRRORED
    from caphy.training.validate import SHORTEST

    print(
        f"{garment.name}: {len(garment.vertices)} vertices, {len(trainer.track.motions)} frames of {_counted(trained)} "
        f"(mirrored, at three speeds), {_counted(held_out)} held out"
    )
    if initial is not None and "transferred_from" in initial.record:
        begun = initial.record
        avatar, apart = begun["transferred_from"], begun["apart_mm"]
        print(f"begins as the {begun['garment']} of the avatar {avatar}, {apart:.0f} mm from it in the median")
    if trainer.scans is not None:
        physics = "" if trainer.scans.loss.physics else ", no physics"
        images = sum(name.endswith(MIRRORED) for name in trainer.scans.motions.names)
        count = f"{len(trainer.scans.motions) - images} scans{' and their mirror images' if images else ''}"
        for why in trainer.scans.left_out:
            print(f"left out: {why}")
        print(f"{count}, lambda_3d {trainer.scans.loss.weight:g} J/m^2{physics}")
    if trainer.held_out is None:
        print(f"note: nothing is validated, no clip held out has {SHORTEST} frames at {trainer.network.fps:g} fps")
    for name, what in blind_spots(trainer.objective.potential).items():
        print(f"note: {name} depends on {what}, which the network does not see: it learns the average")


def _counted(motions: list[PoseSequence]) -> str:
    return f"{len(motions)} clip{'s' * (len(motions) != 1)}"


def _with_worn(options: Train, garment: Garment) -> Train:
    """The options with which part of a scan the garment is, where scans are learnt from; ``reopen`` has no file's name
    to tell it by."""
    from caphy.commands.supervision import worn_part

    if options.scans is None or options.worn is not None:
        return options
    return replace(options, worn=worn_part(options.garment, garment))


def _scans(options: Train, objective: Objective, network: GarmentNetwork) -> Scans | None:
    if options.scans is None:
        return None
    from caphy.commands.supervision import supervision
    from caphy.training.scans import LAMBDA_3D

    assert options.worn is not None
    weight = LAMBDA_3D if options.lambda_3d is None else options.lambda_3d
    return supervision(options.scans, options.worn, options.outermost, objective, network, weight, options.physics)


def reopen(folder: Path, poses: tuple[Path, ...] = ()) -> Trainer:
    """The training that 'caphy train' wrote into a folder, on its trained network and the garment kept beside it; other
    files it read must still be there, but for the motions, which ``poses`` finds where they lie now.

    For :func:`caphy.commands.onward.onward` and for looking at losses; the trainer's own checkpoint is not loaded.

    Raises:
        CaphyError: the folder holds no training, or the motions are others than it was on.
    """
    from caphy.register.styles import KINDS

    path = folder / OPTIONS
    try:
        given = json.loads(path.read_text())
        known = [f for f in fields(Train) if f.name in given]
        options = Train(**{f.name: option(f.type, given[f.name], folder.resolve()) for f in known})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CaphyError(f"{folder}: is not a folder that 'caphy train' wrote: {error!r}") from error
    # of trainings from before their options told it: the copy beside the network is called otherwise
    worn = options.garment.stem if options.scans is not None and options.garment.stem in KINDS else None
    on = replace(options, worn=options.worn or worn, garment=folder / GARMENT, model=folder / MODEL)
    on = replace(on, output=folder, init=folder, transfer=None, fabric=None)
    if poses and on.poses:
        on = replace(on, poses=poses, held_out=tuple(_found_again(path, poses) for path in on.held_out))
    return prepare(on, record=False)


def _same_clips(options: Train) -> tuple[list[PoseSequence], list[PoseSequence]]:
    """As :func:`_clips` of a training that was begun; raises :class:`CaphyError` where it was on other motions."""
    trained, held_out = _clips(options)
    require_same_motions(options.output, trained)
    return trained, held_out


def _found_again(path: Path, poses: tuple[Path, ...]) -> Path:
    """A file or folder of motions, or what is called so among ``poses`` where it is not there any more."""
    among = (each for place in poses for each in (place, *(place.rglob(path.name) if place.is_dir() else ())))
    return path if path.exists() else next((each for each in among if each.name == path.name), path)


def _found(options: Train) -> Train:
    """The options with bundled files' paths, and the body that --scans brings along."""
    from caphy.commands.body import body_path
    from caphy.register.subject import SUBJECT_BODY

    own = None if options.scans is None else options.scans / SUBJECT_BODY
    body = None if options.body is None else body_path(options.body)
    if body is None and own is not None and own.is_file():
        body = own
    init, transfer = (None if path is None else bundled(path) for path in (options.init, options.transfer))
    return replace(options, garment=bundled(options.garment), init=init, transfer=transfer, body=body)


def _model(options: Train, initial: Initial | None) -> Model:
    from caphy.effects.model import Model
    from caphy.effects.presets import fabric_model, snug_model

    if options.model is not None:
        return on_body(Model.load(options.model), initial, options.model, options.init)
    if options.fabric is not None:
        return fabric_model(options.fabric)
    if initial is not None:
        return Model.from_json(json.dumps(initial.model), f"the model of {options.init}; give one with --model")
    return snug_model()


def on_body(model: Model, initial: Initial | None, path: Path, init: Path | None = None) -> Model:
    """A model with what holds a garment off and on its body, which one of cloth on pins lacks, as the network that
    training begins with had it, or else SNUG has."""
    from caphy.effects.model import Model
    from caphy.effects.presets import snug_model

    known, whose = snug_model(), "SNUG"
    if initial is not None and initial.model:
        known, whose = Model.from_json(json.dumps(initial.model), str(init)), str(init)
    lacking = [name for name in BODY_EFFECTS if name in known.effects and name not in model.effects]
    for name in lacking:
        model = model.with_effect(name, **known.effects[name])
    if lacking and os.environ.get("RANK", "0") == "0":
        print(f"note: {path} is of cloth that no body wears: {' and '.join(lacking)} are taken from {whose}")
    return model


def _clips(options: Train) -> tuple[list[PoseSequence], list[PoseSequence]]:
    """Motions to train on and motions held out."""
    from caphy.io.poses.parts import file_of, part
    from caphy.io.procedural import procedural_motion
    from caphy.training.motions import find_poses

    if options.poses:
        clips = find_poses(options.poses)
        if not clips:
            given = ", ".join(map(str, options.poses))
            raise CaphyError(f"{given}: steps too fast for a body leave no half second of motion; give others")
    else:
        clips = [procedural_motion(seed, PROCEDURAL_SECONDS, FPS) for seed in PROCEDURAL]
    extra = [procedural_motion(seed, PROCEDURAL_SECONDS, FPS) for seed in range(MADE_UP, MADE_UP + options.made_up)]
    if options.held_out:
        unseen = find_poses(options.held_out)
        names = {Path(file_of(clip.source)).resolve() for clip in unseen}
        trained = [clip for clip in clips if Path(file_of(clip.source)).resolve() not in names] + extra
        if not trained:
            raise CaphyError("all motions are held out, so there is none to train on; give others")
        return trained, unseen
    recordings = list(dict.fromkeys(file_of(clip.source) for clip in clips))
    if len(recordings) < 6:
        longest = max(reversed(clips), key=len)
        cut = max(1, int(0.8 * len(longest)))
        begun = [part(clip, 0, cut) if clip is longest else clip for clip in clips]
        return begun + extra, [part(longest, cut, len(longest)) if cut < len(longest) else longest]
    kept = recordings[5::6]  # whole: what tracking errors cut apart is still one motion
    trained, unseen = ([clip for clip in clips if (file_of(clip.source) in kept) is out] for out in (False, True))
    return trained + extra, unseen
