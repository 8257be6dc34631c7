"""The network beside the reference solver on the same clip, from the same start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from caphy.body.model import BodyModel
from caphy.effects.base import BodyState, Step
from caphy.effects.potential import Potential
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.network.garment_network import GarmentNetwork
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton
from caphy.solve.statics import drape, drape_on_body
from caphy.training.objective import ground_energies


@dataclass(frozen=True)
class Comparison:
    """Network and solver over frames 1 to T - 1 of a clip; energies as each meets its own implicit Euler steps.

    distance: mean distance between their vertices in each frame, (T - 1,) [m]. Cloth that buckles has many answers.
    correction: mean distance by which the solver moves the network's vertices, starting from them and their own
        past, (T - 1,) [m]: zero where the network's answer is one of the solver's.
    corrected: total potential [J] of the frames so moved, (T - 1,): what the network has above it is what it has yet to
        learn. Potentials along different pasts, as the following are, need not be ordered so.
    network, solver, template: total potential [J] in each frame, (T - 1,): of the network, of the solver, and of the
        skinned template (the network before training), weight relative to the last.
    """

    distance: np.ndarray
    correction: np.ndarray
    corrected: np.ndarray
    network: np.ndarray
    solver: np.ndarray
    template: np.ndarray

    def summary(self) -> dict[str, float]:
        """Means under names that carry their units. A closed share of 1 means: as low as the solver."""
        gained, possible = self.template - self.network, self.template - self.solver
        return {
            "distance_to_solver_mm": 1e3 * float(self.distance.mean()),
            "correction_by_solver_mm": 1e3 * float(self.correction.mean()),
            "excess_potential_J": float((self.network - self.corrected).mean()),
            "potential_J": float(self.network.mean()),
            "potential_of_solver_J": float(self.solver.mean()),
            "potential_of_skinned_template_J": float(self.template.mean()),
            "share_of_solver_s_decrease": float(gained.mean() / possible.mean()),
            "share_of_solver_s_decrease_median": float(np.median(gained / possible)),
        }


def compare_with_solver(
    network: GarmentNetwork, potential: Potential, body: BodyModel, garment: Garment, clip: PoseSequence, betas=None
) -> Comparison:
    """Stream a clip at the network's frame rate and solve it with implicit Euler.

    Frame 0 serves as the frame before the start, as in training. Frame 1 is a static drape; from then on both step
    with their own history. ``potential`` in float64 on the CPU.
    """
    motion = BodyMotion(body, clip, garment, betas)
    poses, transl = motion.poses.poses[1:], motion.poses.transl[1:]
    predicted = torch.from_numpy(network.stream(poses, transl)).double()
    template = torch.from_numpy(motion.anchors(motion.times[1:]))
    newton = Newton(potential)
    solved, corrected = solve(newton, motion), correct(newton, motion, predicted)
    ground = sum(ground_energies(potential, template).values(), template.new_zeros(len(template))).numpy()
    energies = (step_energies(potential, motion, x) - ground for x in (predicted, solved, template))
    reached = step_energies(potential, motion, corrected, past=predicted) - ground
    return Comparison(_apart(predicted, solved), _apart(predicted, corrected), reached, *energies)


def solve(newton: Newton, motion: BodyMotion) -> Tensor:
    """Implicit Euler's trajectory (T - 1, V, 3) [m] from a static drape in frame 1 of a motion."""
    return _onwards(newton, motion, drape_on_body(newton, motion, float(motion.times[1]))[0])


def solve_from(newton: Newton, motion: BodyMotion, start: Tensor) -> Tensor:
    """As :func:`solve`, from the static drape nearest to positions ``start`` (V, 3) [m] in frame 1 of a motion."""
    body = _body(motion, float(motion.times[1]), 1 / motion.fps)
    return _onwards(newton, motion, drape(newton, start, body)[0])


def _onwards(newton: Newton, motion: BodyMotion, x: Tensor) -> Tensor:
    """Implicit Euler's trajectory (T - 1, V, 3) [m] from rest at x (V, 3) in frame 1 of a motion."""
    frames = [carried_back(motion, x), x]
    for time in motion.times[2:].tolist():
        step = Step.implicit_euler(1 / motion.fps, frames[-1], frames[-2], time)
        guess = motion.carried(frames[-1].numpy(), step.target.numpy(), time - step.dt, time)
        frames.append(newton.minimise(torch.from_numpy(guess), step, _body(motion, time, step.dt))[0])
    return torch.stack(frames[1:])


def correct(newton: Newton, motion: BodyMotion, x: Tensor) -> Tensor:
    """What the solver makes of each frame of a trajectory (T - 1, V, 3) [m], from that frame and its own past."""
    dt = 1 / motion.fps
    frames = []
    for time, step, guess in zip(motion.times[1:].tolist(), steps_of(motion, x), x, strict=True):
        body = _body(motion, time, dt)
        frames.append((drape(newton, guess, body) if step is None else newton.minimise(guess, step, body))[0])
    return torch.stack(frames)


def step_energies(potential: Potential, motion: BodyMotion, x: Tensor, past: Tensor | None = None) -> np.ndarray:
    """Total potential (T - 1,) [J] of a trajectory (T - 1, V, 3) that starts at rest in frame 1 of a motion.

    Each frame follows its own trajectory's last two frames, or those of the trajectory ``past``.
    """
    dt, total = 1 / motion.fps, []
    steps = steps_of(motion, x if past is None else past)
    for time, step, frame in zip(motion.times[1:].tolist(), steps, x, strict=True):
        energies = potential.energies(frame, step, _body(motion, time, dt)(frame))
        total.append(sum(float(e) for e in energies.values()))
    return np.array(total)


def steps_of(motion: BodyMotion, x: Tensor) -> list[Step | None]:
    """Implicit Euler's steps along a trajectory (T - 1, V, 3) that starts at rest in frame 1 of a motion."""
    history = [carried_back(motion, x[0]), *x]
    dt, times = 1 / motion.fps, motion.times[2:].tolist()
    return [None, *(Step.implicit_euler(dt, b, a, t) for (a, b), t in zip(pairwise(history[:-1]), times, strict=True))]


def _body(motion: BodyMotion, time: float, dt: float) -> Callable[[Tensor], BodyState]:
    return lambda x: motion.state(time, x.numpy(), dt)


def _apart(a: Tensor, b: Tensor) -> np.ndarray:
    return (a - b).norm(dim=-1).mean(-1).numpy()


def carried_back(motion: BodyMotion, x: Tensor) -> Tensor:
    """Where the canonical offsets of positions x (V, 3) in frame 1 would be in frame 0 of a motion."""
    blended = torch.from_numpy(motion.transforms(motion.times[:2]))
    now = blended[1]
    canonical = torch.linalg.solve(now[..., :3], (x - now[..., 3])[..., None])[..., 0]
    return (blended[0, ..., :3] @ canonical[..., None])[..., 0] + blended[0, ..., 3]
