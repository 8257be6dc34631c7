"""How good a network is on motions it has not seen."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from caphy.effects.cloth import Cloth
from caphy.network.garment_network import GarmentNetwork
from caphy.training.motions import Motions
from caphy.training.objective import Objective, Past, Scene, ground_energies
from caphy.training.streams import Windows

CHUNK = 30
"""Frames evaluated at once: bounds memory."""
SETTLED = 5
"""Frames at the start of a clip that do not count: the stream has no past yet."""
SHORTEST = SETTLED + 4
"""Frames of the shortest clip that there is something to measure in."""
DEEP = 0.001
"""A vertex further inside the body than this counts as deep [m]."""


@dataclass(frozen=True)
class Frames:
    """Measures of T frames. Energies are those of the implicit Euler step from the trajectory's own last frames.

    energy: name -> (T,) [J]; see :func:`~caphy.training.objective.ground_energies` for where that of weight is zero.
    stretch: largest principal stretch minus one of each face, (T, F).
    deep: share of vertices more than 1 mm inside the body, (T,).
    shake: root-mean-square acceleration of the vertices relative to the body, (T,) [m/s^2].
    """

    energy: dict[str, np.ndarray]
    stretch: np.ndarray
    deep: np.ndarray
    shake: np.ndarray

    def summary(self) -> dict[str, float | dict[str, float]]:
        """Means and percentiles under names that carry their units."""
        total = sum(self.energy.values())
        median, high, highest = np.percentile(self.stretch, [50, 95, 99])
        return {
            "potential_J": _round(np.mean(total)),
            "potential_median_J": _round(np.median(total)),
            "energies_J": {name: _round(value.mean()) for name, value in self.energy.items()},
            "stretch_percent_p50": _round(100 * median),
            "stretch_percent_p95": _round(100 * high),
            "stretch_percent_p99": _round(100 * highest),
            "deeper_than_1mm_percent": _round(100 * self.deep.mean()),
            "acceleration_on_body_m_per_s2": _round(np.median(self.shake)),
        }


@torch.no_grad()
def validate(network: GarmentNetwork, objective: Objective, motions: Motions) -> Frames:
    """Measure a network streaming through each of the clips of ``motions`` from a cold start."""
    parts = []
    for first, last in pairwise(motions.starts.tolist()):
        past, hidden, tail = standing(network.template), None, None
        for start in range(first + 1, last, CHUNK):
            windows = clip_windows(start, min(start + CHUNK, last), start == first + 1)
            offsets, hidden = network.offsets(windows.features(motions).to(network.template), hidden)
            scene, past = objective.scene(motions, windows, offsets, past)
            frames = measure(objective, scene, offsets if tail is None else torch.cat([tail, offsets], 1))
            parts.append((frames, SETTLED if tail is None else 0))
            tail = offsets[:, -2:]
    return _joined(parts)


def standing(template: Tensor) -> Past:
    """A past for one stream that is about to start: nothing reads it."""
    return Past(template[None], template[None])


def clip_windows(start: int, stop: int, fresh: bool) -> Windows:
    """The frames of a clip from ``start`` to ``stop`` as the one window of one stream, all of them scored."""
    frames = np.arange(start, stop)[None]
    return Windows(frames, np.array([start - 1]), np.array([fresh]), np.array([False]), frames - start)


def measure(objective: Objective, scene: Scene, offsets: Tensor) -> Frames:
    """Measures of the one stream of ``scene``; offsets (1, T or T + 2, V, 3) [m] may begin two frames early."""
    energy = objective.potential.energies(scene.x, scene.step, scene.body)
    for name, ground in ground_energies(objective.potential, scene.body.anchor).items():
        energy[name] = energy[name] - ground
    depth = ((scene.body.point - scene.x) * scene.body.normal).sum(-1)
    shake = (torch.diff(offsets, n=2, dim=1) / objective.dt**2).square().sum(-1).mean(-1).sqrt()
    return Frames(
        {name: value[0].double().cpu().numpy() for name, value in energy.items()},
        largest_stretch(scene.x[0].cpu(), objective.potential.cloth),
        (depth > DEEP).double().mean(-1)[0].cpu().numpy(),
        shake[0].cpu().numpy(),
    )


def largest_stretch(x: Tensor, cloth: Cloth) -> np.ndarray:
    """Largest principal stretch minus one (T, F) of each face at positions (T, V, 3) [m]."""
    a, b, c = (x[:, torch.as_tensor(corner)] for corner in cloth.faces.T.astype(np.int64))
    inverse = torch.as_tensor(cloth.face_inverse).to(x)
    gradient = torch.stack([b - a, c - a], -1) @ inverse
    metric = gradient.mT @ gradient
    half = 0.5 * (metric[..., 0, 0] + metric[..., 1, 1])
    spread = torch.sqrt(0.25 * (metric[..., 0, 0] - metric[..., 1, 1]) ** 2 + metric[..., 0, 1] ** 2)
    return (torch.sqrt(half + spread) - 1).numpy()


@torch.no_grad()
def static_drape(network: GarmentNetwork, pose: Tensor, transl: Tensor, frames: int = 30) -> Tensor:
    """Vertices (V, 3) [m] of one pose (55, 3) [rad] held at ``transl`` (3,) until the stream has settled."""
    held = pose.expand(frames, *pose.shape), transl.expand(frames, 3)
    return network(*held, network.initial_state())[0][-1]


@torch.no_grad()
def stream_drift(network: GarmentNetwork, poses: Tensor, transl: Tensor, frames: int = 10_000) -> float:
    """Largest distance [m] between the stream's last pass through a motion and its second pass, over ``frames`` frames.

    The motion (T, 55, 3), (T, 3) is played back and forth without pause, so that each pass meets the same frames
    after the same past; what differs is only how long the network has been streaming.
    """
    there = torch.arange(len(poses))
    loop = torch.cat([there, there.flip(0)[1:-1]])
    passes = max(3, -(-frames // len(loop)))
    state, seen = network.initial_state(), []
    for _ in range(passes):
        vertices, state = network(poses[loop], transl[loop], state)
        seen = [*seen[:2], vertices]
    return float((seen[-1] - seen[1]).norm(dim=-1).max())


def _joined(parts: list[tuple[Frames, int]]) -> Frames:
    return Frames(
        {name: np.concatenate([f.energy[name][skip:] for f, skip in parts]) for name in parts[0][0].energy},
        np.concatenate([f.stretch[skip:] for f, skip in parts]),
        np.concatenate([f.deep[skip:] for f, skip in parts]),
        np.concatenate([f.shake[skip:] for f, skip in parts]),
    )


def _round(value: float | np.floating) -> float:
    return float(np.format_float_positional(value, 5, unique=False, fractional=False))
