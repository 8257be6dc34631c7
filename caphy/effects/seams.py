"""The openings of a garment, where hems, cuffs and bands are sewn: edges of its boundary loops, lowest loop first."""

from __future__ import annotations

import numpy as np

from caphy.effects.cloth import Cloth
from caphy.garment.topology import boundary_loops, half_edges

LOOPS = 4
"""Parameters of seams hold one value for each of the four lowest openings; values of openings that a garment lacks
do nothing, and what is sewn to a fifth cannot be said."""

LEVEL = 0.01
"""Openings whose mean heights differ by less than this [m] from that of the next one count as level, such as two cuffs;
the one at greater x (the wearer's left) comes first."""


def seams(cloth: Cloth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges (B, 2), loop (B,) and rest length (B,) [m] of the four lowest openings."""
    loops = ordered_loops(cloth)[:LOOPS]
    starts = half_edges(cloth.faces)
    sides = np.linalg.norm(np.roll(cloth.material, -1, axis=1) - cloth.material, axis=-1).reshape(-1)
    length = dict(zip(map(tuple, starts.tolist()), sides.tolist(), strict=True))
    edges = [np.stack([loop, np.roll(loop, -1)], 1) for loop in loops]
    ends = np.concatenate([*edges, np.zeros((0, 2), dtype=np.int64)])
    number = np.repeat(np.arange(len(loops)), [len(loop) for loop in loops])
    return ends, number, np.array([length[pair] for pair in map(tuple, ends.tolist())])


def ordered_loops(cloth: Cloth) -> list[np.ndarray]:
    """Boundary loops of a cloth, each in order of its faces' winding, by mean height and then from the left."""
    loops = boundary_loops(cloth.faces)
    x, y, _ = np.array([cloth.vertices[loop].mean(0) for loop in loops]).reshape(-1, 3).T
    upwards = np.argsort(y, kind="stable")
    level = np.zeros(len(loops), dtype=int)
    level[upwards[1:]] = np.cumsum(np.diff(y[upwards]) >= LEVEL)
    return [loops[k] for k in np.lexsort((-x, level))]


def per_loop(number: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Amounts (B,) spread to their loops' rows, (LOOPS, B): a parameter (LOOPS,) times it is the amount's share."""
    return np.where(np.arange(LOOPS)[:, None] == number, amount, 0.0)
