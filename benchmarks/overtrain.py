"""The bundled T-shirt's network, over-trained on one short clip, beside the solver.

    OMP_NUM_THREADS=1 python -m benchmarks.overtrain [POSES] [--seconds 0.5] [--minutes 3]

The network minimises the solver's own potential, so it should end where the solver does. Cloth that nothing holds in
place has many minima, some far apart and some close, so three distances are told: to the solver on its own from a
static drape; to the solver set going from the network's first frame; and by how much the solver moves each of the
network's frames, given that frame's own past. The last is zero where the network has found a minimum, whichever it is.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from caphy.body.bundled import default_body, default_body_path
from caphy.effects.cloth import Cloth
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence, read_poses
from caphy.io.procedural import procedural_motion
from caphy.network.garment_network import GarmentNetwork
from caphy.report.render import vertex_normals
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton
from caphy.training.motions import Motions
from caphy.training.objective import Objective, ground_energies
from caphy.training.overtrain import overtrain
from caphy.training.reference import correct, solve, solve_from, step_energies

FPS = 30.0


@dataclass(frozen=True)
class Options:
    """Over-train and compare."""

    poses: Annotated[Path | None, tyro.conf.Positional] = None
    """A pose file; a made-up motion unless given."""
    start: float = 1.0
    """Where in it to begin [s]."""
    seconds: float = 0.5
    """How much of it to learn [s]."""
    minutes: float = 3.0
    """How long to train."""
    garment: Path = default_body_path().parent / "garments" / "tshirt.npz"
    """A garment's npz."""


def main(options: Options) -> None:
    """Train, solve three ways, print."""
    clip = (procedural_motion(0, 20.0, FPS) if options.poses is None else read_poses(options.poses)).resample(FPS)
    first = round(options.start * FPS)
    clip = clip[first : first + round(options.seconds * FPS) + 2]
    garment, body, model = Garment.load(options.garment), default_body(), snug_model()
    torch.manual_seed(0)
    potential = Potential(model, Cloth.of(garment, model.density))
    network = trained(garment, potential, clip, options.minutes)

    motion, newton = BodyMotion(body, clip, garment), Newton(potential)
    predicted = torch.from_numpy(network.stream(motion.poses.poses[1:], motion.poses.transl[1:])).double()
    template = torch.from_numpy(motion.anchors(motion.times[1:]))
    ground = sum(ground_energies(potential, template).values(), template.new_zeros(len(template))).numpy()
    start = time.monotonic()
    own, following = solve(newton, motion), solve_from(newton, motion, predicted[0])
    corrected = correct(newton, motion, predicted)
    print(f"solver: three times {len(predicted)} frames in {time.monotonic() - start:.0f} s")

    others = {"solver alone": own, "solver from the network's start": following}
    answer = "solver's answer to each frame"
    energy = {name: step_energies(potential, motion, x) - ground for name, x in others.items()}
    energy[answer] = step_energies(potential, motion, corrected, past=predicted) - ground
    mine, untrained = (step_energies(potential, motion, x) - ground for x in (predicted, template))
    for part, rows in (("static, the first frame", slice(0, 1)), ("dynamic, the other frames", slice(1, None))):
        print(f"{part}: potential {mine[rows].mean():.4f} J, skinned template {untrained[rows].mean():.4f} J")
        for name, x in {**others, answer: corrected}.items():
            theirs = energy[name][rows].mean()
            share = (untrained - mine)[rows].mean() / (untrained[rows].mean() - theirs)
            print(
                f"  {name}: {theirs:.4f} J, ratio {mine[rows].mean() / theirs:.3f}, share of its decrease {share:.4f}"
            )
            print(f"    distance {apart(predicted[rows], x[rows], garment.faces)}")


def trained(garment: Garment, potential: Potential, clip: PoseSequence, minutes: float) -> GarmentNetwork:
    """A network over-trained on a clip."""
    body = default_body()
    network = GarmentNetwork(garment.vertices, garment.weights, body.joints, fps=FPS)
    motions = Motions.of([clip], body, network.driving, FPS)
    quick = Potential(potential.model, potential.cloth, torch.float32)
    objective = Objective(quick, body, network.template, network.weights, FPS)
    last = [time.monotonic()]

    def say(done: float, loss: float) -> None:
        if time.monotonic() - last[0] > 20:
            last[0] = time.monotonic()
            print(f"  {100 * done:3.0f} %  potential {loss:.4f} J  {(1 - done) * minutes:.1f} min left", flush=True)

    steps = overtrain(network, objective, motions, 10**6, 60 * minutes, progress=say)
    print(f"{garment.name}: {len(garment.vertices)} vertices, {len(clip) - 1} frames, {steps} steps in {minutes:g} min")
    return network


def apart(a: torch.Tensor, b: torch.Tensor, faces: np.ndarray) -> str:
    """Mean distance of trajectories (T, V, 3), and the parts of it: the common shift, across the cloth, along it."""
    gap = (a - b).numpy()
    normals = np.stack([vertex_normals(frame, faces) for frame in b.numpy()])
    shift = gap.mean(axis=1, keepdims=True)
    rest = gap - shift
    across = np.abs((rest * normals).sum(-1))
    along = np.linalg.norm(rest - (rest * normals).sum(-1, keepdims=True) * normals, axis=-1)
    size = np.linalg.norm(gap, axis=-1)
    parts = (size.mean(), np.median(size), np.linalg.norm(shift, axis=-1).mean(), across.mean(), along.mean())
    return "mean {:.2f}, median {:.2f} mm (common shift {:.2f}, across the cloth {:.2f}, along it {:.2f})".format(
        *(1e3 * float(part) for part in parts)
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
