"""Nested dissection: the elimination order of a mesh that keeps its Cholesky factor small and its fronts dense."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

_LEAF = 24  # vertices; measured best between 16 and 100 for meshes of 1,000 to 4,400 vertices


@dataclass(frozen=True)
class Separator:
    """One node of the elimination tree: its vertices are eliminated after those of all its children."""

    vertices: np.ndarray
    """Vertex indices, (n,)."""
    children: tuple[int, ...]
    """Places of the children in the list of separators; they come earlier."""


def dissect(pattern: csr_array, positions: np.ndarray) -> list[Separator]:
    """Separators of a graph in elimination order, children before parents (George, SIAM J. Numer. Anal. 10, 1973).

    Args:
        pattern: which vertices share an element, (V, V), symmetric, diagonal included.
        positions: where the vertices lie at rest [m], (V, 3); each part is cut across its longest extents.
    """
    separators: list[Separator] = []

    def visit(vertices: np.ndarray) -> int:
        middle, parts = _cut(pattern, positions, vertices)
        children = tuple(visit(part) for part in parts)
        separators.append(Separator(middle, children))
        return len(separators) - 1

    visit(np.arange(len(positions)))
    return separators


def _cut(pattern: csr_array, positions: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """A separator of a part and the (at most two) parts it leaves."""
    if len(vertices) <= _LEAF:
        return vertices, []
    graph = pattern[vertices][:, vertices]
    centred = positions[vertices] - positions[vertices].mean(0)
    axes = np.linalg.eigh(centred.T @ centred).eigenvectors.T
    middle = min((_boundary(graph, centred @ axis) for axis in axes), key=np.count_nonzero)
    rest = np.flatnonzero(~middle)
    if len(rest) == 0:
        return vertices, []
    halves = _balanced(connected_components(graph[rest][:, rest])[1])
    return vertices[middle], [vertices[rest[half]] for half in halves]


def _boundary(graph: csr_array, height: np.ndarray) -> np.ndarray:
    """Mask of the smaller of the two boundary layers between the lower and the upper half of the vertices."""
    below = np.zeros(len(height), bool)
    below[np.argsort(height, kind="stable")[: len(height) // 2]] = True
    touches_above = graph @ (~below).astype(float) > 0
    touches_below = graph @ below.astype(float) > 0
    lower, upper = below & touches_above, ~below & touches_below
    return lower if lower.sum() <= upper.sum() else upper


def _balanced(label: np.ndarray) -> list[np.ndarray]:
    """Connected components dealt to two groups of nearly equal size; empty groups are left out."""
    sizes = np.bincount(label)
    group, weight = np.zeros(len(sizes), int), [0, 0]
    for component in np.argsort(-sizes).tolist():
        side = int(weight[1] < weight[0])
        group[component] = side
        weight[side] += int(sizes[component])
    return [half for half in (np.flatnonzero(group[label] == side) for side in (0, 1)) if len(half)]
