"""``caphy fit SCANS -o RUN``: from scans of a person to an avatar with its own clothes, in one go."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from caphy.commands.following import following
from caphy.commands.output import OUTPUT
from caphy.commands.seed import require_seed
from caphy.commands.training_options import require_device, require_positive
from caphy.errors import CaphyError
from caphy.io.places import writable_folder


@dataclass(frozen=True)
class Fit:
    """Make an avatar of a person's scans: checks, segments, registers, trains, exports, evaluates, and reports.

    Run it again to go on where it was stopped; what is done and whose input has not changed is not done again.
    """

    scans: tyro.conf.Positional[Path]
    """Folder of scans with a scans.toml; see docs/scans.md."""
    output: Annotated[Path, OUTPUT]
    """Folder of the run: gets avatar/, report.html, evaluation.json, and what every stage leaves."""
    poses: tuple[Path, ...] = ()
    """Pose files, or folders of them, whose motions the physics is learnt on; without any, motions are made."""
    minutes: float = 60.0
    """How long to train in all, collisions aside."""
    steps: int | None = None
    """How many steps to train in all, instead of minutes, collisions aside."""
    parser: str | None = None
    """colour, labels, or an ONNX human parser, as of 'caphy segment'; labels if all scans come with some, else
    colour."""
    layout: str = "schp-atr"
    """What the classes of an ONNX parser are."""
    body: str = "medium"
    """An SMPL-X-format npz, or "medium" or "fine" for the bundled body."""
    licence: str | None = None
    """Licence of a body of your own, in words; it goes into the avatar."""
    fabric: str = "gray-interlock"
    """The measured fabric to start from."""
    fabric_rounds: int = 8
    """Rounds of the fit of the fabric, at most."""
    fabric_scans: int = 20
    """Scans that the fabric is fitted to, at most; at least 3."""
    collision_epochs: int = 10
    """How long to fine-tune against collisions, in passes through the scans' poses."""
    hold_out: Literal["random", "unlike"] = "random"
    """Which fifth of the scans is kept for the evaluation: drawn from the seed, or the poses least like the rest."""
    vgg: Path | None = None
    """Weights of VGG-16 for the perceptual error instead of FLIP."""
    seed: int = 0
    """Decides the split and what training draws."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    processes: int = 1
    """Among how many processes each training's streams are divided, as torchrun does: 1, 2, 4 or 8. On cuda each has
    a GPU of its own."""


def main(arguments: list[str]) -> int:
    """Run ``caphy fit`` with the arguments after it; 1 if the run is complete but for something told."""
    options = tyro.cli(Fit, args=arguments, prog="caphy fit")
    _check(options)
    writable_folder(options.output)

    from caphy.commands.fit_scans import left_out
    from caphy.commands.fit_stages import AVATAR, PAGE, Plan, stages
    from caphy.pipeline.runner import run_stages
    from caphy.scan.scan_set import ScanSet

    scans = ScanSet.read(options.scans)
    given = {name: value for name, value in vars(options).items() if name != "output"}
    plan = Plan(run=options.output, **given)
    options.output.mkdir(parents=True, exist_ok=True)
    outcome = run_stages(stages(plan, len(scans), scans.beyond), options.output)
    for name, why in left_out(options.output).items():
        print(f"left out: {name}: {why}")
    for name, why in outcome.failed.items():
        print(f"without {name}: {why}")
    print(f"{sum(outcome.seconds.values()) / 60:.1f} min in all, {len(outcome.kept)} stages kept from before")
    if "report" not in outcome.failed:
        print(f"report: {options.output / PAGE}")
    print(f"next: {following('serve', '--avatars', options.output / AVATAR)}")
    return 1 if outcome.failed else 0


def _check(options: Fit) -> None:
    from caphy.commands.fit_scans import SCANS
    from caphy.material.fabrics import fabric

    require_seed(options.seed)
    require_positive(options, "minutes", "steps", "fabric_rounds", "collision_epochs")
    if options.processes not in (1, 2, 4, 8):
        raise CaphyError(f"--processes must divide the 8 streams of a training: 1, 2, 4 or 8, got {options.processes}")
    require_device(options.device, options.processes - 1)
    if options.fabric_scans < 3:
        raise CaphyError(f"--fabric-scans must be at least 3, got {options.fabric_scans}")
    fabric(options.fabric)
    if options.body not in ("medium", "fine") and options.licence is None:
        raise CaphyError("a body of your own needs its licence in words, which goes into the avatar: --licence TEXT")
    missing = [path for path in (*options.poses, *([options.vgg] if options.vgg else [])) if not path.exists()]
    if missing:
        raise CaphyError(f"{missing[0]}: there is no such file or folder")
    _check_files(options)
    for path in options.poses:
        places = options.output.resolve(), Path(os.path.abspath(options.output))  # it may be a link in there
        if any(place.is_relative_to(folder) for place in places for folder in (path.resolve(), path.absolute())):
            raise CaphyError(
                f"--poses {path}: must not hold the folder of the run, {options.output}, whose own files would be "
                "taken for motions; give the folder of the motions alone, or another with -o"
            )
    if options.output.resolve().is_relative_to(options.scans.resolve()):
        raise CaphyError(f"{options.output}: must not lie within the folder of the scans, which is only read")
    if options.scans.resolve().is_relative_to((options.output / SCANS).resolve()):
        raise CaphyError(
            f"{options.scans}: lies where the run puts scans of its own, in metres and y up; give another folder "
            f"with -o, such as {options.output / 'run'}"
        )


def _check_files(options: Fit) -> None:
    """Raise CaphyError where a body, a parser or weights are none, which stages would find after hours."""
    from caphy.commands.body import load_body
    from caphy.scan.label_layouts import find_layout

    load_body(options.body)
    own = options.parser not in (None, "colour", "labels")
    if own and not Path(options.parser or "").is_file():
        raise CaphyError(
            f"--parser must be colour, labels, or the file of an ONNX human parser, got {options.parser!r}"
        )
    find_layout(options.layout)
    if not own and options.layout != Fit.layout:
        raise CaphyError("--layout says what the classes of an ONNX parser are; give that with --parser")
    if options.vgg is not None:
        from caphy.evaluate.perceptual import Vgg16

        Vgg16(options.vgg)
