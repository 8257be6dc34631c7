"""Frames per second of training a 4,424-vertex shirt, everything included, and what the time goes to.

python -m benchmarks.training_speed [--steps 12] [--threads 2] [--device cuda]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from benchmarks.effects_speed import T_SHIRT, tube
from caphy.body.bundled import default_body
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.io.procedural import procedural_motion
from caphy.network.garment_network import GarmentNetwork
from caphy.recorded import WARM
from caphy.training import streams
from caphy.training.loop import Schedule, Trainer
from caphy.training.motions import Motions
from caphy.training.objective import Objective

HIPS = 0.1
"""Height of the tube's lower edge above the pelvis, downwards [m]."""


def trainer(folder: Path, device: str = "cpu") -> Trainer:
    """A trainer of a tube of a shirt's size round the trunk of the bundled body."""
    cloth, body = tube(*T_SHIRT), default_body()
    cloth.vertices[:, 1] -= HIPS
    distance = np.linalg.norm(cloth.vertices[:, None, ::4] - body.v_template[None, ::9, ::4], axis=2)
    weights = body.weights[::9][distance.argmin(1)]
    network = GarmentNetwork(cloth.vertices, weights, body.joints).to(device)
    motions = Motions.of([procedural_motion(0, 10.0, 30.0)], body, network.driving, 30.0)
    potential = Potential(snug_model(), cloth, torch.float32, device)
    objective = Objective(potential, body, network.template, network.weights, 30.0)
    return Trainer(folder, network, objective, motions, None, Schedule(), say=lambda text: None)


def timed(owner: object, name: str, spent: dict[str, float]) -> Callable[[], None]:
    """Count the time inside a method; returns how to stop."""
    method = getattr(owner, name)

    def wrapper(*args, **kwargs):
        start = time.perf_counter()
        try:
            return method(*args, **kwargs)
        finally:
            spent[name] = spent.get(name, 0.0) + time.perf_counter() - start

    setattr(owner, name, wrapper)
    return lambda: setattr(owner, name, method)


def measure(steps: int, scored: int, device: str = "cpu") -> None:
    """Print frames per second with ``scored`` frames of each window of five under the physics loss."""
    streams.SCORED = scored
    with tempfile.TemporaryDirectory() as folder:
        training = trainer(Path(folder), device)
        for _ in range(WARM + 2):  # a GPU works some steps through before it records them
            training.step()
        spent: dict[str, float] = {}
        timed(training.objective, "body_state", spent)
        timed(training.objective.potential, "gradient", spent)
        timed(training.optimizer, "step", spent)
        start, worked = time.perf_counter(), time.process_time()
        for _ in range(steps):
            training.step()
        total, worked = time.perf_counter() - start, time.process_time() - worked
    frames = steps * training.schedule.streams * streams.WINDOW
    spent["network and skinning, both ways"] = total - sum(spent.values())
    names = {"body_state": "body and nearest points", "gradient": "potential and gradient", "step": "optimizer"}
    shares = ", ".join(f"{names.get(name, name)} {100 * part / total:.0f} %" for name, part in spent.items())
    print(
        f"  {scored} of {streams.WINDOW} frames scored: {frames / total:5.0f} frames/s, "
        f"{frames * scored / streams.WINDOW / total:5.0f} scored frames/s, {frames / worked:.0f} frames per second of "
        f"processor time, whatever else runs ({shares})"
    )


def main() -> None:
    """Print both figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    count = T_SHIRT[0] * T_SHIRT[1]
    where = f"{arguments.threads} threads, {arguments.device}"
    print(f"training, forward, backward and step, float32, {count} vertices, {where}")
    for scored in (streams.SCORED, streams.WINDOW):
        measure(arguments.steps, scored, arguments.device)


if __name__ == "__main__":
    main()
