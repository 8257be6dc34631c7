"""Speed of the network loss and of the solver's element Hessians, as ratios measured in one run.

python -m benchmarks.effects_speed [--frames 24] [--repeats 5]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch

from caphy.effects import potential as potential_module
from caphy.effects.base import BodyState, Effect, Step
from caphy.effects.cloth import Cloth
from caphy.effects.potential import Potential
from caphy.effects.presets import fabric_model, snug_model

T_SHIRT = (56, 79)  # 4,424 vertices, as SNUG's T-shirt
SOLVER = (40, 50)  # 2,000 vertices


def tube(around: int, along: int) -> Cloth:
    """An open tube of a T-shirt's chest and length."""
    angle = np.arange(around) * 2 * np.pi / around
    height = np.linspace(0, 0.7, along)
    ring = np.stack([0.16 * np.cos(angle), np.zeros(around), 0.16 * np.sin(angle)], 1)
    vertices = (ring[None] + height[:, None, None] * (0, 1, 0)).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(along - 1))
    a, b = (j * around + i).ravel(), (j * around + (i + 1) % around).ravel()
    faces = np.concatenate([np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1)])
    side = np.linalg.norm(ring[1] - ring[0]), height[1]
    lower, upper = np.array([(0, 0), (0, 1), (-1, 0)]), np.array([(-1, 0), (0, 1), (-1, 1)])
    material = np.repeat(np.stack([lower, upper]) * side, len(a), axis=0)
    attached = np.zeros(len(vertices))
    attached[-around:] = 1
    return Cloth(vertices, faces, material, 0.2, np.zeros(len(vertices)), attached)


def moment(cloth: Cloth, frames: tuple[int, ...], dtype: torch.dtype) -> tuple[torch.Tensor, Step, BodyState]:
    """Noisy positions with a step and a body."""
    generator = torch.Generator().manual_seed(0)
    rest = torch.as_tensor(cloth.vertices, dtype=dtype)

    def near(noise: float) -> torch.Tensor:
        return rest + noise * torch.randn((*frames, *rest.shape), generator=generator, dtype=dtype)

    normal = torch.nn.functional.normalize(rest * torch.tensor([1, 0, 1], dtype=dtype), dim=-1).expand(*frames, -1, -1)
    step = Step.implicit_euler(1 / 30, near(1e-3), near(1e-3))
    return near(1e-3), step, BodyState(near(0) - 0.003 * normal, normal, torch.zeros_like(normal), near(1e-3))


def seconds(work: Callable[[], object], repeats: int) -> float:
    """Best wall-clock time of several runs after one to warm up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def loss_and_backward(potential: Potential, x: torch.Tensor, step: Step, body: BodyState) -> None:
    """One training step's share of the physics."""
    potential.loss(x.requires_grad_(True), step, body).sum().backward()


def automatic(potential: Potential, x: torch.Tensor, step: Step, body: BodyState) -> None:
    """The same by automatic differentiation of the energies."""
    total = sum(energy.sum() for energy in potential.energies(x.requires_grad_(True), step, body).values())
    assert isinstance(total, torch.Tensor)
    total.backward()


def training(frames: int, repeats: int) -> None:
    """Frames per second of the full loss, forward and backward."""
    cloth = tube(*T_SHIRT)
    print(
        f"full loss, forward and backward, float32, {len(cloth.vertices)} vertices, {torch.get_num_threads()} threads"
    )
    state = moment(cloth, (frames,), torch.float32)
    for name, model in {
        "SNUG cotton": snug_model(),
        "gray interlock (measured)": fabric_model("gray-interlock"),
    }.items():
        potential = Potential(model, cloth, torch.float32)
        kernel_of = potential_module.kernel_of
        fast = frames / seconds(lambda p=potential: loss_and_backward(p, *state), repeats)
        potential_module.kernel_of = lambda effect: None
        plain = frames / seconds(lambda p=potential: loss_and_backward(p, *state), repeats)
        potential_module.kernel_of = kernel_of
        slow = frames / seconds(lambda p=potential: automatic(p, *state), repeats)
        print(
            f"  {name:26s} compiled {fast:6.0f} frames/s | closed form {plain:6.0f} | automatic {slow:6.0f}"
            f" | ratios {fast / slow:.1f} : {plain / slow:.1f} : 1"
        )


def solver(repeats: int) -> None:
    """Milliseconds for the projected Hessians of all elements of one frame."""
    cloth = tube(*SOLVER)
    x, step, body = moment(cloth, (), torch.float64)
    print(f"projected element Hessians, float64, {len(cloth.vertices)} vertices, {torch.get_num_threads()} threads")
    for name, model in {
        "SNUG cotton": snug_model(),
        "gray interlock (measured)": fabric_model("gray-interlock"),
    }.items():
        potential = Potential(model, cloth)

        def closed(p: Potential = potential) -> None:
            for _, term, elements in p.acting(x, step, body):
                term.effect.projected_hessian(elements, term.values)

        def automatic_hessians(p: Potential = potential) -> None:
            for _, term, elements in p.acting(x, step, body):
                Effect.hessian(term.effect, elements, term.values)

        fast, slow = seconds(closed, repeats), seconds(automatic_hessians, 1)
        print(f"  {name:26s} closed form {fast * 1e3:6.1f} ms | automatic, unprojected {slow * 1e3:7.1f} ms")


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    training(arguments.frames, arguments.repeats)
    solver(arguments.repeats)


if __name__ == "__main__":
    main()
