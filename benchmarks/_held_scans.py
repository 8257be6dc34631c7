"""How far a network's cloth lies from the points of scans, each pose held until the cloth has settled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from caphy.network.garment_network import GarmentNetwork
from caphy.register.points import ScanPoints
from caphy.training.counterparts import Target
from caphy.training.scans import Chamfer
from caphy.training.validate import static_drape


@dataclass(frozen=True)
class Apart:
    """Distances [m], averaged over scans: half the sum of both sides' means, and the root of half of their squares."""

    mean: float
    root: float

    def __str__(self) -> str:
        return f"{1e3 * self.mean:5.2f} / {1e3 * self.root:5.2f}"


def held(network: GarmentNetwork, scan: ScanPoints) -> np.ndarray:
    """Vertices (V, 3) [m] in a scan's pose."""
    place = (torch.tensor(part, dtype=torch.float32) for part in (scan.pose, scan.transl))
    return static_drape(network, *place).double().numpy()


def apart(chamfer: Chamfer, targets: Sequence[Target], cloth: Sequence[np.ndarray]) -> Apart:
    """Of cloth (V, 3), one for each target; what the scans do not show of it does not count."""
    figures = []
    for target, x in zip(targets, cloth, strict=True):
        nearest, shown = target.counterparts(x)
        there = np.linalg.norm(x - nearest, axis=1)[shown]
        back = np.abs(chamfer.surface.nearest(target.sample, x).distance)
        figures.append((0.5 * (there.mean() + back.mean()), 0.5 * ((there**2).mean() + (back**2).mean())))
    mean, square = np.mean(figures, axis=0)
    return Apart(float(mean), float(np.sqrt(square)))
