"""How far networks' cloth is from rest: in the poses of held-out scans, and where the solver takes it from there.

    OMP_NUM_THREADS=1 python -m benchmarks.relaxed RUN NETWORK... [--worn upper] [--iterations 16]

RUN is a folder after ``caphy register body|garments|points``, each NETWORK one that ``caphy train`` wrote for its upper
or lower garment. A line for each: distances from the scans (mean / root mean square), the potential and how much of it
is strain, then both for the same cloth relaxed by the reference solver, and how far that moved it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

from benchmarks._held_scans import apart, held
from caphy.commands.train import reopen
from caphy.effects.potential import Potential
from caphy.evaluate.dressed import Subject
from caphy.io.poses import PoseSequence
from caphy.register.points import ScanPoints, read_points
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton
from caphy.training.counterparts import Target
from caphy.training.scans import Chamfer

_STRAIN = ("strain_measured", "strain_stvk")
_REST = 1e-6
"""Force on the worst vertex [N] at which cloth would count as at rest; iterations end before."""


@dataclass(frozen=True)
class Options:
    """What to relax."""

    run: tyro.conf.Positional[Path]
    networks: tyro.conf.Positional[tuple[Path, ...]]
    worn: Literal["upper", "lower"] = "upper"
    iterations: int = 16
    """Of the solver, at most: as many as fall into the nearest folds, before a shirt begins to slide."""


def main(options: Options) -> None:
    """Relax and print."""
    torch.set_num_threads(1)
    subject, scans = Subject.read(options.run), read_points(options.run, "held_out")
    over = () if options.worn == "upper" else ("upper",)
    targets = [Target.of(scan, options.worn, over) for scan in scans]
    for folder in options.networks:
        trainer = reopen(folder)
        potential = Potential(trainer.objective.potential.model, trainer.objective.potential.cloth)
        sheet = potential.cloth
        chamfer = Chamfer(sheet.faces, sheet.vertices, sheet.vertex_area)
        cloth = [held(trainer.network, scan) for scan in scans]
        found = [_relaxed(potential, subject, options, scan, x) for scan, x in zip(scans, cloth, strict=True)]
        rest = [x for x, _ in found]
        before, strain, after, moved, up = np.mean([figures for _, figures in found], axis=0)
        print(
            f"{folder}: {apart(chamfer, targets, cloth)} mm, {before:.2f} J, {strain:.2f} of it strain; relaxed "
            f"{apart(chamfer, targets, rest)} mm, {after:.2f} J, moved {1e3 * moved:.1f} mm, {1e3 * up:.1f} upwards",
            flush=True,
        )


def _relaxed(
    potential: Potential, subject: Subject, options: Options, scan: ScanPoints, x: np.ndarray
) -> tuple[np.ndarray, tuple[float, float, float, float, float]]:
    """Vertices (V, 3) [m] where the solver takes them; potential, strain, potential there [J], and the way [m]: its
    root mean square and its mean upwards."""
    still = PoseSequence(scan.pose[None], scan.transl[None], fps=30.0, pelvis=subject.body.joints[0])
    motion = BodyMotion(subject.body, still, subject.garments[options.worn])

    def body(x: torch.Tensor):
        return motion.state(0.0, x.numpy(), 1.0)

    def energies(x: torch.Tensor) -> dict[str, float]:
        return {name: float(energy) for name, energy in potential.energies(x, None, body(x)).items()}

    start = torch.from_numpy(x)
    rest, _ = Newton(potential, tolerance=_REST, max_iterations=options.iterations).minimise(start, None, body)
    before, after, way = energies(start), energies(rest), (rest - start).numpy()
    strain = sum(before.get(name, 0.0) for name in _STRAIN)
    root = float(np.sqrt((way**2).sum(axis=1).mean()))
    return rest.numpy(), (sum(before.values()), strain, sum(after.values()), root, float(way[:, 1].mean()))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
