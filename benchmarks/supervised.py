"""What supervision by scans is worth, by the weight of their distances, and what a step costs.

    OMP_NUM_THREADS=1 python -m benchmarks.supervised RUN MOTIONS... [--worn upper] [--steps 700] [-o OUT]

RUN is a folder after ``caphy register body|garments|points``. Each network starts from nothing and gets the same number
of steps: physics alone, scans alone, and both with several weights. Distances are in millimetres, mean / root mean
square, of scans trained on and of scans held out, each pose held until the cloth has settled.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from benchmarks._held_scans import apart, held
from caphy.commands.train import Train, prepare, reopen
from caphy.register.points import read_points
from caphy.register.subject import SUBJECT_BODY
from caphy.training.counterparts import Target
from caphy.training.loop import Trainer
from caphy.training.scans import Chamfer
from caphy.training.track import Track


@dataclass(frozen=True)
class Options:
    """Train and compare."""

    run: tyro.conf.Positional[Path]
    motions: tyro.conf.Positional[tuple[Path, ...]]
    worn: Literal["upper", "lower"] = "upper"
    steps: int = 700
    weights: tuple[float, ...] = (300.0, 3000.0, 30000.0)
    """lambda_3d [J/m^2]."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Keeps the networks, and what is there is not trained again."""
    rows: tuple[str, ...] = field(default=("physics", "scans", "both"))
    """Which trainings."""


def main(options: Options) -> None:
    """Train, print."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.output or Path(scratch)
        rows: dict[str, dict] = {"physics": {"physics alone": {"scans": None}}}
        rows["scans"] = {"scans alone": {"physics": False}}
        rows["both"] = {f"both, lambda_3d {w:g} J/m^2": {"lambda_3d": w} for w in options.weights}
        for kind in options.rows:
            for number, (name, more) in enumerate(rows[kind].items()):
                _row(options, folder / f"{options.worn}_{kind}{number}", name, more)


def _row(options: Options, folder: Path, name: str, more: dict) -> None:
    given = Train(
        garment=options.run / f"{options.worn}.npz", poses=options.motions, output=folder, steps=options.steps,
        **{"scans": options.run, "body": options.run / SUBJECT_BODY, **more},
    )  # fmt: skip
    cost = ""
    if not (folder / "network.safetensors").is_file():
        trainer = prepare(given)
        trainer.say = lambda text: None
        cost = _cost(trainer)
        trainer.run()
    trainer, over = reopen(folder), () if options.worn == "upper" else ("upper",)
    sheet = trainer.objective.potential.cloth
    chamfer = Chamfer(sheet.faces, sheet.vertices, sheet.vertex_area)
    print(f"{name:<32}", end="")
    for part in ("train", "held_out"):
        points = read_points(options.run, part)
        cloth = [held(trainer.network, scan) for scan in points]
        targets = [Target.of(scan, options.worn, over) for scan in points]
        print(f"  {part} {apart(chamfer, targets, cloth)} mm", end="")
    print(cost, flush=True)


def _cost(trainer: Trainer, steps: int = 6) -> str:
    """Processor time of a step on motions and on scans, of a trainer that then starts over."""
    told = []
    for name, track in (("motions", trainer.track), ("scans", trainer.scan_track)):
        if track is not None:
            told.append(f"{name} {_frames_per_second(trainer, track, steps):.0f}")
    return f"  ({', '.join(told)} frames per second of processor time)"


def _frames_per_second(trainer: Trainer, track: Track, steps: int) -> float:
    place, past, hidden = track.streams.place.copy(), track.past, track.hidden
    track.advance(trainer.model)
    started = time.process_time()
    for _ in range(steps):
        track.advance(trainer.model)[1].mean().backward()
    spent = time.process_time() - started
    track.streams.restore(place)
    track.past, track.hidden = past, hidden
    return steps * trainer.schedule.streams * 5 / spent


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
