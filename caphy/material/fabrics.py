"""The ten measured fabrics, and what is read from their tables.

Measured by Wang, O'Brien and Ramamoorthi (SIGGRAPH 2011); see ``caphy/data/fabrics/README.md`` for the layout of the
tables and their caveats.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caphy.errors import CaphyError

FOLDER = Path(__file__).parents[1] / "data" / "fabrics"

STRETCH_SAMPLED = 1 / 6
"""Largest principal stretch, less one, at which rows 1-5 of a stretching table were sampled."""

BEND_SPACING = 5.0
"""Spacing [1/m] of the curvatures of a bending table's columns: 0, 5, 10, 15, 20."""

LOADED_TWICE = 2.0
"""Stiffness that a stretching table's figures stand for, over the figures (ARCSim's loader doubles them)."""


@dataclass(frozen=True)
class Fabric:
    """One measured fabric.

    Attributes:
        name: as in :func:`fabric_names`.
        density: area density [kg/m^2].
        stretching: stretching table [N/m], (6, 4): C_uuuu, C_uuvv, C_vvvv, C_uv of half the stiffness, in rows near
            zero strain and at 16.7 % stretch in five directions.
        bending: bending table [N m], (3, 5); see :func:`bending_stiffness`.
        source: who measured it.
    """

    name: str
    density: float
    stretching: np.ndarray
    bending: np.ndarray
    source: str


def fabric_names() -> list[str]:
    """Names of the measured fabrics, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.json"))


def fabric(name: str) -> Fabric:
    """A measured fabric by name; raises :class:`CaphyError` with the known names."""
    if name not in fabric_names():
        raise CaphyError(f"there is no measured fabric {name!r}; known: {', '.join(fabric_names())}")
    data = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    return Fabric(name, data["density"], np.array(data["stretching"]), np.array(data["bending"]), data["source"])


def bending_stiffness(table: np.ndarray, angle: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Bending stiffness (...,) [N m] at an edge's angle from the weft [rad] and a curvature [1/m].

    The curvature of a hinge is theta l / (2 (A_0 + A_1)); its size counts. Linear between the rows (0, 45, 90
    degrees) and columns (0, 5, 10, 15, 20 1/m), constant beyond 20 1/m, never negative.
    """
    folded = np.abs((np.asarray(angle) + np.pi / 2) % np.pi - np.pi / 2)
    row = np.clip(folded / (np.pi / 4), 0, 2)
    column = np.clip(np.abs(curvature) / BEND_SPACING, 0, 4)
    i, j = np.minimum(row.astype(int), 1), np.minimum(column.astype(int), 3)
    s, t = row - i, column - j
    left, right = (1 - s) * table[i, j] + s * table[i + 1, j], (1 - s) * table[i, j + 1] + s * table[i + 1, j + 1]
    return np.maximum((1 - t) * left + t * right, 0)
