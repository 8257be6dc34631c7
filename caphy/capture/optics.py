"""How well the cameras see."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Optics:
    """How well the rig sees. Lengths in metres."""

    noise: float = 0.001
    """Standard deviation of each coordinate of a scan's vertices; at most 0.05."""
    voxel: float = 0.006
    """Edge of the fusion's voxels, 0.002 to 0.05; a scan's edges are about as long."""
    pixels: tuple[int, int] = (320, 400)
    """Width and height of each camera's picture; at most 4096."""
    dropouts: int = 6
    """Holes of 1 to 3 cm radius where the scanner failed."""
