"""Garments that pass through each other, before and after fine-tuning, in poses that were held out.

    OMP_NUM_THREADS=1 python -m benchmarks.collision RUN LOWER UPPER -o OUT --held-out MOTIONS... [--epochs 10]

RUN holds the points of scans ('caphy register points'), LOWER and UPPER are folders of these names that ``caphy train
--scans RUN`` wrote, innermost first. OUT gets the fine-tuned ones (what is there is not made again) and a picture.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from benchmarks._held_scans import Apart, apart, held
from caphy.commands.collide import Collide, prepare
from caphy.commands.train import reopen
from caphy.network.garment_network import GarmentNetwork
from caphy.register.points import ScanPoints, read_points
from caphy.report.camera import Camera
from caphy.report.render import CLOTH, SKIN, Shape, contact_sheet, render, write_png
from caphy.training.collide import DEEP
from caphy.training.counterparts import Target
from caphy.training.layers import Layers
from caphy.training.loop import Trainer
from caphy.training.motions import find_poses

EVERY = 10
"""Frames of the motions that are looked at: each tenth."""
SIZE = (420, 420)


@dataclass(frozen=True)
class Options:
    """Fine-tune and compare."""

    run: tyro.conf.Positional[Path]
    trainings: tyro.conf.Positional[tuple[Path, ...]]
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    held_out: tuple[Path, ...]
    epochs: int = 10


def main(options: Options) -> None:
    """Fine-tune, print, picture."""
    before = [reopen(folder) for folder in options.trainings]
    if not (options.output / "checkpoint.safetensors").is_file():
        started = time.process_time()
        prepare(Collide(options.trainings, options.output, options.epochs)).run()
        print(f"fine-tuned in {time.process_time() - started:.0f} s of processor time")
    after = [reopen(options.output / folder.resolve().name) for folder in options.trainings]
    layers = Layers([training.objective.potential.cloth for training in before])
    scans = read_points(options.run, "held_out")
    parts = [folder.resolve().name for folder in options.trainings]
    for what, poses in (
        ("scans held out", lambda networks: (_in_scan(networks, scan) for scan in scans)),
        ("motions held out", lambda networks: _in_motions(networks, options.held_out)),
    ):
        counts = [_deep(layers, poses([t.network for t in trainings])) for trainings in (before, after)]
        (old, met, deepest), (new, _, left) = counts
        print(f"{what}: vertices over 1 mm on the wrong side of another garment {old} -> {new} of {met} that meet one:")
        print(f"  {100 * (1 - new / max(old, 1)):.1f} % fewer (95); deepest {deepest:.1f} -> {left:.1f} mm")
    sums = np.zeros(2)
    for i, part in enumerate(parts):
        over = tuple(parts[i + 1 :])
        figures = [_distances(trainings[i], part, over, scans) for trainings in (before, after)]
        sums += [figure.mean for figure in figures]
        print(f"{part}: distance from scans held out, mean / rms: {figures[0]} -> {figures[1]} mm")
    print(
        f"both: mean {1e3 * sums[0] / 2:.2f} -> {1e3 * sums[1] / 2:.2f} mm, {100 * (sums[1] / sums[0] - 1):+.1f} % (2)"
    )
    print(write_png(_picture(before, after, layers, scans), options.output / "collision.png"))


def _in_scan(networks: Sequence[GarmentNetwork], scan: ScanPoints) -> list[np.ndarray]:
    return [held(network, scan) for network in networks]


def _in_motions(networks: Sequence[GarmentNetwork], paths: Sequence[Path]) -> Iterator[list[np.ndarray]]:
    for clip in find_poses(paths):
        motion = clip.to_y_up(networks[0].joints[0].double().numpy()).resample(networks[0].fps)
        streams = [network.stream(motion.poses, motion.transl) for network in networks]
        for frame in range(EVERY, len(motion), EVERY):
            yield [vertices[frame].astype(np.float64) for vertices in streams]


def _deep(layers: Layers, poses) -> tuple[int, int, float]:
    """Vertices deeper than 1 mm, vertices that meet another garment, and the greatest depth [mm]."""
    depths = np.concatenate([layers.depths(vertices) for vertices in poses])
    return int((depths > DEEP).sum()), len(depths), 1e3 * float(depths.max())


def _distances(training: Trainer, part: str, over: tuple[str, ...], scans: Sequence[ScanPoints]) -> Apart:
    assert training.scans is not None
    cloth = [held(training.network, scan) for scan in scans]
    return apart(training.scans.loss.chamfer, [Target.of(scan, part, over) for scan in scans], cloth)


def _picture(
    before: Sequence[Trainer], after: Sequence[Trainer], layers: Layers, scans: Sequence[ScanPoints]
) -> np.ndarray:
    """Before and after, on the two held-out scans with the most collisions: what meets wrongly shows its colour."""
    counts = [_deep(layers, [_in_scan([t.network for t in before], scan)])[0] for scan in scans]
    worst = [scans[i] for i in np.argsort(counts)[::-1][:2]]
    images, labels = [], []
    for scan in worst:
        for when, trainings in (("before", before), ("after", after)):
            body = trainings[0].objective.body
            shapes = [Shape(body.pose(scan.pose[None], scan.transl[None])[0], body.faces, SKIN)]
            dressed = _in_scan([t.network for t in trainings], scan)
            for layer, (training, x) in enumerate(zip(trainings, dressed, strict=True)):
                shapes.append(Shape(x, training.objective.potential.cloth.faces, CLOTH[2 - layer % 2]))
            number = _deep(layers, [dressed])[0]
            waist = scan.transl + body.joints[0]
            around = waist + np.array([[-0.33, -0.30, -0.2], [0.33, 0.36, 0.2]])
            for azimuth in (20.0, 200.0):
                images.append(render(shapes, Camera.framing(around, azimuth), SIZE))
                labels.append(f"{scan.name} {when}: {number} deep")
    return contact_sheet(images, 4, labels)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
