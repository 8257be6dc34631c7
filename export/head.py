"""The network's linear head as a product of two thin matrices."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence
from caphy.network.features import pose_features
from caphy.network.garment_network import GarmentNetwork
from caphy.rotations import matrix_from_axis_angle

RANKS = (32, 48, 64, 80, 96, 128, 192, 256)
TOLERANCE = 1e-4
"""Largest distance of a vertex from where the full head puts it [m]."""


@dataclass(frozen=True)
class Head:
    """Offsets (3V,) = expand @ (reduce @ h) + bias.

    expand: (3V, rank) [m]. reduce: (rank, width). bias: (3V,) [m]; vertex by vertex, x y z.
    """

    expand: np.ndarray
    reduce: np.ndarray
    bias: np.ndarray

    @property
    def rank(self) -> int:
        """Width of the bottleneck."""
        return len(self.reduce)

    def rounded(self) -> Head:
        """``expand`` as float16 holds it: a graph of half the size."""
        return replace(self, expand=self.expand.astype(np.float16).astype(np.float64))


def hidden_states(network: GarmentNetwork, motions: Sequence[PoseSequence]) -> np.ndarray:
    """Inputs of the head (N, width) over motions, each streamed from rest at the network's frame rate."""
    found = []
    for motion in motions:
        resampled = motion.to_y_up().resample(network.fps)
        poses, transl = (torch.tensor(a).to(network.template) for a in (resampled.poses, resampled.transl))
        with torch.no_grad():
            state = network.initial_state()
            rotations = matrix_from_axis_angle(poses)
            features, _ = pose_features(rotations, transl, state[network.hidden_size :], network.driving, network.fps)
            found.append(network.gru(features)[0].double().numpy())
    return np.concatenate(found)


def low_rank_head(network: GarmentNetwork, hidden: np.ndarray, rank: int) -> Head:
    """The best head of ``rank`` for inputs distributed as ``hidden`` (N, width).

    A singular value decomposition of W L, L L^T the inputs' covariance, minimises the mean squared error of the
    offsets themselves. A ridge of 1e-3 of the mean variance keeps directions the motions never took.
    """
    weight = network.head.weight.detach().double().numpy()
    bias = network.head.bias.detach().double().numpy()
    mean = hidden.mean(axis=0)
    covariance = np.cov(hidden.T) if len(hidden) > 1 else np.zeros((len(mean), len(mean)))
    ridge = 1e-3 * max(float(np.trace(covariance)) / len(mean), 1e-6)
    factor = np.linalg.cholesky(covariance + ridge * np.eye(len(mean)))
    left, values, right = np.linalg.svd(weight @ factor, full_matrices=False)
    expand = left[:, :rank] * values[:rank]
    reduce = np.linalg.solve(factor.T, right[:rank].T).T
    return Head(expand, reduce, bias + (weight @ mean - expand @ (reduce @ mean)))


def worst_error(network: GarmentNetwork, head: Head, hidden: np.ndarray) -> float:
    """Largest distance [m] of any vertex, at any of the inputs (N, width), from where the full head puts it."""
    rest = network.head.weight.detach().double().numpy() - head.expand @ head.reduce
    shift = network.head.bias.detach().double().numpy() - head.bias
    worst = 0.0
    for part in np.array_split(hidden, max(1, len(hidden) // 64)):
        gap = (part @ rest.T + shift).reshape(len(part), -1, 3)
        worst = max(worst, float(np.linalg.norm(gap, axis=-1).max()))
    return worst


def smallest_head(
    network: GarmentNetwork, fitted: np.ndarray, held_out: np.ndarray, tolerance: float = TOLERANCE
) -> tuple[Head, float]:
    """The head of lowest rank that keeps ``tolerance`` [m] on ``held_out`` inputs, rounding included, and its error."""
    width = network.gru.hidden_size
    for rank in [r for r in RANKS if r < width] + [width]:
        head = low_rank_head(network, fitted, rank).rounded()
        error = worst_error(network, head, held_out)
        if error <= tolerance:
            return head, error
    raise CaphyError(f"no head keeps {tolerance * 1e3} mm; the network's weights are not usable")


def with_head(network: GarmentNetwork, head: Head) -> GarmentNetwork:
    """A float64 copy of the network with ``head`` in the place of its own."""
    copied = copy.deepcopy(network).double()
    with torch.no_grad():
        copied.head.weight.copy_(torch.as_tensor(head.expand @ head.reduce))
        copied.head.bias.copy_(torch.as_tensor(head.bias))
    return copied
