"""Seconds per frame of the reference solver on one core: T-shirts on the bundled body, and cloth on shaken pins.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.solver_speed [POSES] [--frames N]

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
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.effects.trial import flat_cloth
from caphy.garment.families import Tshirt, make
from caphy.io.poses import PoseSequence, read_poses
from caphy.io.procedural import procedural_motion
from caphy.solve.assembly import Hessian
from caphy.solve.body_motion import BodyMotion
from caphy.solve.factorize import Factor
from caphy.solve.integrators import SDIRK2, ImplicitEuler, Integrator, State
from caphy.solve.newton import Newton
from caphy.solve.preroll import start_state
from caphy.solve.rollout import Simulator

EDGES = {"1k": 0.0325, "2k": 0.0227, "4.4k": 0.0152}
"""Edge lengths [m] of T-shirts of about so many vertices."""

FPS = 30.0


@dataclass(frozen=True)
class Options:
    """What to run."""

    poses: Annotated[Path | None, tyro.conf.Positional] = None
    """A pose file; a procedural motion without one."""
    frames: int = 8
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


def worn(
    name: str, poses: PoseSequence, tolerance: float, integrator: Integrator, friction: float = 0.0
) -> tuple[Simulator, State]:
    """A T-shirt on the moving body, and where it starts."""
    body = default_body()
    garment = make(replace(Tshirt(), edge_length=EDGES[name]), body)
    model = snug_model()
    if friction:
        model = model.with_effect("body_friction", coefficient=friction)
    newton = Newton(Potential(model, Cloth.of(garment, model.density)), tolerance=tolerance)
    motion = BodyMotion(body, poses, garment)
    return Simulator(newton, motion, integrator), start_state(newton, motion)


def pinned(tolerance: float, cells: int = 34) -> tuple[Simulator, State]:
    """A square metre held at two corners which are shaken, by SDIRK2."""
    cloth = flat_cloth(cells, cells, 1.0, 1.0)
    x = torch.from_numpy(cloth.vertices.copy())
    top = np.flatnonzero(cloth.vertices[:, 1] == cloth.vertices[:, 1].max())
    fixed = np.zeros(len(x), bool)
    fixed[[top[cloth.vertices[top, 0].argmin()], top[cloth.vertices[top, 0].argmax()]]] = True
    rest = x[torch.from_numpy(fixed)]

    def pins(now: float) -> torch.Tensor:
        turn = 2 * np.pi * 1.5 * now
        shift = [0.1 * np.sin(turn), 0.05 * np.sin(1.7 * turn), 0.1 * np.cos(1.3 * turn) - 0.1]
        return rest + torch.tensor([shift, [shift[0] - 0.15 * (1 - np.cos(turn)), *shift[1:]]], dtype=torch.float64)

    model = Model(0.2, {name: {} for name in ("strain_stvk", "bending", "gravity", "inertia")})
    newton = Newton(Potential(model, cloth), fixed, tolerance)
    return Simulator(newton, None, SDIRK2(), pins), State(0.0, x, torch.zeros_like(x))


def measure(label: str, simulator: Simulator, state: State, frames: int, substeps: int, spent: Counter) -> None:
    """Simulate and print one line."""
    spent.clear()
    seconds, reports = [], []
    for frame in range(frames):
        start = time.process_time()
        state, report = simulator.advance(State(frame / FPS, state.x, state.v), 1 / FPS, substeps)
        seconds.append(time.process_time() - start)
        reports += report
    shares = ", ".join(f"{part} {100 * used / sum(seconds):.0f} %" for part, used in sorted(spent.items()))
    print(
        f"{label:24}{len(state.x):9d}{np.mean(seconds):9.2f}{np.median(seconds):8.2f}{len(reports) / frames:7.0f}"
        f"{np.mean([report.iterations for report in reports]):8.1f}"
        f"{np.mean([report.converged for report in reports]):10.0%}  {shares}",
        flush=True,
    )


def main() -> None:
    """Print one line per cloth."""
    options = tyro.cli(Options)
    torch.set_num_threads(1)
    poses = procedural_motion(0, 2.0, FPS) if options.poses is None else read_poses(options.poses).resample(FPS)
    poses = poses[: options.frames + 1]
    spent: Counter = Counter()
    timed(spent, "hessian", Hessian, "values")
    timed(spent, "factor", Hessian, "factorize")
    timed(spent, "solve", Factor, "solve")
    timed(spent, "gradient", Potential, "gradient")
    timed(spent, "contact", BodyMotion, "state")
    print(f"{'':24}{'vertices':>9}{'s/frame':>9}{'median':>8}{'minima':>7}{'newton':>8}{'converged':>10}  share")
    for name in EDGES:
        shirt = worn(name, poses, options.tolerance, ImplicitEuler())
        measure("T-shirt, implicit Euler", *shirt, len(poses) - 1, 1, spent)
    for friction in (0.0, 0.3):  # by SDIRK2
        shirt = worn("2k", poses, options.tolerance, SDIRK2(), friction)
        measure(f"T-shirt, friction {friction}", *shirt, len(poses) - 1, 1, spent)
    measure("pins, SDIRK2 twice", *pinned(options.tolerance), 3 * options.frames, 2, spent)


if __name__ == "__main__":
    main()
