"""A small world to train in: a tube of cloth held at its top round the trunk of the bundled body, two short motions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from caphy.body.bundled import default_body
from caphy.conventions import JOINT_COUNT
from caphy.effects.cloth import Cloth
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.network.garment_network import GarmentNetwork
from caphy.training.loop import Schedule, Trainer
from caphy.training.motions import Motions
from caphy.training.objective import Objective


def tube(around: int = 14, rings: int = 6) -> Garment:
    """A tube of cloth round the hips, 25 cm long, held at its upper edge."""
    angle = 2 * np.pi * np.arange(around) / around
    height = np.linspace(-0.13, 0.12, rings)
    ring = np.stack([0.21 * np.sin(angle), np.zeros(around), 0.17 * np.cos(angle) + 0.01], -1)
    vertices = (ring[None] + height[:, None, None] * [0, 1, 0]).reshape(-1, 3)
    i, k = np.divmod(np.arange((rings - 1) * around), around)
    a, b = i * around + k, i * around + (k + 1) % around
    faces = np.concatenate([np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)])
    corner = vertices[faces]
    u = corner[:, 1] - corner[:, 0]
    length = np.linalg.norm(u, axis=1)
    across = corner[:, 2] - corner[:, 0]
    along = (across * u).sum(1) / length
    high = np.sqrt((across**2).sum(1) - along**2)
    zero = np.zeros(len(faces))
    material = np.stack([np.stack([zero, zero], 1), np.stack([length, zero], 1), np.stack([along, high], 1)], 1)
    weights = np.zeros((len(vertices), JOINT_COUNT))
    weights[:, 0], weights[:, 3] = 0.6, 0.4
    held = np.zeros(len(vertices))
    held[-around:] = 1
    regions = np.full(len(vertices), "tube")
    return Garment("tube", vertices, faces.astype(np.int32), material, weights, regions, 0 * held, held)


def swaying(frames: int = 40, seed: int = 0) -> PoseSequence:
    """Hips and spine turning to and fro while the root travels a little, at 30 Hz."""
    random = np.random.default_rng(seed)
    time = np.arange(frames) / 30
    poses = np.zeros((frames, JOINT_COUNT, 3))
    for joint in (0, 3, 16, 17):
        phase = random.uniform(0, 2 * np.pi, 3)
        poses[:, joint] = 0.3 * np.sin(2 * np.pi * 0.8 * time[:, None] + phase)
    transl = 0.1 * np.sin(2 * np.pi * 0.6 * time[:, None] + random.uniform(0, 6, 3))
    return PoseSequence(poses, transl, 30.0, source=f"swaying {seed}")


def small_trainer(folder: Path, streams: int = 4, steps: int = 6, seed: int = 0, device: str = "cpu") -> Trainer:
    """A trainer of the tube on two motions."""
    torch.manual_seed(seed)
    garment, body = tube(), default_body()
    network = GarmentNetwork(garment.vertices, garment.weights, body.joints, layers=2, width=24).to(device)
    motions = Motions.of([swaying(40, 0), swaying(25, 1)], body, network.driving, 30.0)
    model = snug_model()
    potential = Potential(model, Cloth.of(garment, model.density), torch.float32, device)
    objective = Objective(potential, body, network.template, network.weights, 30.0)
    schedule = Schedule(steps, None, streams)
    folder.mkdir(parents=True, exist_ok=True)
    return Trainer(folder, network, objective, motions, None, schedule, seed, say=lambda text: None)
