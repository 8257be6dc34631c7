"""Over-training on one short clip: what the loss, freed from all else, makes of a network."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch

from caphy.network.garment_network import GarmentNetwork
from caphy.training.learner import Learner, stiffness
from caphy.training.motions import Motions
from caphy.training.objective import Objective
from caphy.training.validate import clip_windows, standing


def overtrain(
    network: GarmentNetwork,
    objective: Objective,
    motions: Motions,
    steps: int,
    seconds: float = math.inf,
    rate: float = 1e-2,
    progress: Callable[[float, float], None] | None = None,
) -> int:
    """Train a network in place on the first clip of ``motions``, all frames at once from its start; returns the steps.

    Stops after ``steps``, or ``seconds`` [s] if these are over first; the learning rate falls from ``rate`` to a
    hundredth. ``progress`` is told of each step the share done and the mean potential [J].
    """
    learner = Learner(network, stiffness(objective.potential, network.fps))
    optimizer = torch.optim.Adam(learner.parameters())
    windows = clip_windows(1, int(motions.starts[1]), True)
    features = windows.features(motions).to(network.template)
    hidden = features.new_zeros(network.gru.num_layers, 1, network.gru.hidden_size)
    start, taken, done = time.monotonic(), 0, 0.0
    while done < 1:
        optimizer.param_groups[0]["lr"] = rate * (0.505 + 0.495 * math.cos(math.pi * done))
        offsets, _ = learner(features, hidden)
        potential, _ = objective(motions, windows, offsets, standing(network.template))
        optimizer.zero_grad()
        potential.mean().backward()
        optimizer.step()
        taken += 1
        done = max(taken / steps, (time.monotonic() - start) / seconds)
        if progress is not None:
            progress(done, float(potential.detach().mean()))
    learner.fold(network)
    return taken
