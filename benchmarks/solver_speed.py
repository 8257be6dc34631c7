"""Seconds per frame of the reference solver: a T-shirt on the bundled body, at several resolutions, on one core.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.solver_speed POSES [--frames N]

Prints seconds of processor time per dynamic frame at 30 fps, Newton iterations and where the time goes.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from caphy.body.bundled import default_body
from caphy.effects.cloth import Cloth
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.garment.families import Tshirt, make
from caphy.io.poses import read_poses
from caphy.io.procedural import procedural_motion
from caphy.solve.assembly import Hessian
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import INTEGRATORS, find_integrator
from caphy.solve.newton import Newton
from caphy.solve.preroll import start_state
from caphy.solve.rollout import simulate

EDGES = {"1k": 0.0325, "2k": 0.0227, "4.4k": 0.0152}
"""Edge lengths [m] of T-shirts of about so many vertices."""


@dataclass(frozen=True)
class Options:
    """What to run."""

    poses: Annotated[Path | None, tyro.conf.Positional] = None
    """A pose file; a procedural motion without one."""
    frames: int = 30
    """Frames to simulate."""
    tolerance: float = 5e-5
    """Largest force left on any vertex [N]."""


def timed(spent: Counter, label: str, owner: Any, name: str) -> None:
    """Add up the processor time spent in a method."""
    method: Callable = getattr(owner, name)

    def wrapper(*given, **options):
        start = time.process_time()
        result = method(*given, **options)
        spent[label] += time.process_time() - start
        return result

    setattr(owner, name, wrapper)


def main() -> None:
    """Print one line per resolution and integrator."""
    options = tyro.cli(Options)
    torch.set_num_threads(1)
    body = default_body()
    poses = procedural_motion(0, 2.0, 30.0) if options.poses is None else read_poses(options.poses).resample(30.0)
    poses = poses[: options.frames + 1]
    spent: Counter = Counter()
    timed(spent, "hessian", Hessian, "values")
    timed(spent, "factor", Hessian, "factorize")
    timed(spent, "gradient", Potential, "gradient")
    timed(spent, "contact", BodyMotion, "state")
    print(f"{'vertices':>8} {'integrator':>15} {'s/frame':>8} {'median':>7} {'newton':>7} {'converged':>10}  share")
    for edge in EDGES.values():
        garment = make(replace(Tshirt(), edge_length=edge), body)
        model = snug_model()
        potential = Potential(model, Cloth.of(garment, model.density))
        motion = BodyMotion(body, poses, garment)
        start = start_state(Newton(potential), motion)
        for name in INTEGRATORS:
            spent.clear()
            marks = [time.process_time()]
            trajectory = simulate(
                potential,
                motion,
                start,
                find_integrator(name),
                tolerance=options.tolerance,
                progress=lambda done, total, marks=marks: marks.append(time.process_time()),
            )
            seconds = np.diff(marks)
            share = ", ".join(f"{label} {100 * spent[label] / seconds.sum():.0f} %" for label in sorted(spent))
            print(
                f"{len(garment.vertices):8d} {name:>15} {seconds.mean():8.2f} {np.median(seconds):7.2f} "
                f"{trajectory.iterations[1:].mean():7.1f} {trajectory.converged.mean():10.0%}  {share}",
                flush=True,
            )


if __name__ == "__main__":
    main()
