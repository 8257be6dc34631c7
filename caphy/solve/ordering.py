"""Nested dissection: the elimination order of a mesh that keeps its Cholesky factor small and its fronts dense."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

_LEAF = 8  # vertices; measured best between 8 and 40 for meshes of 1,000 to 2,000 vertices
_SHARES = (0.4, 0.45, 0.5, 0.55, 0.6)
_REMEMBERED = 16  # meshes: a diagnosis solves dozens of models on the same few


@dataclass(frozen=True)
class Separator:
    """One node of the elimination tree: its vertices are eliminated after those of all its children."""

    vertices: np.ndarray
    """Vertex indices, (n,)."""
    children: tuple[int, ...]
    """Places of the children in the list of separators; they come earlier."""


_known: OrderedDict[tuple[bytes, ...], list[Separator]] = OrderedDict()


def dissect(pattern: csr_array, positions: np.ndarray) -> list[Separator]:
    """Separators of a graph in elimination order, children before parents (George, SIAM J. Numer. Anal. 10, 1973).

    Args:
        pattern: which vertices share an element, (V, V), symmetric, diagonal included.
        positions: where the vertices lie at rest [m], (V, 3); each part is cut across its longest extents.
    """
    key = (pattern.indptr.tobytes(), pattern.indices.tobytes(), positions.tobytes())
    if key in _known:
        _known.move_to_end(key)
        return _known[key]
    separators: list[Separator] = []

    def visit(vertices: np.ndarray) -> int:
        middle, parts = _cut(pattern, positions, vertices)
        children = tuple(visit(part) for part in parts)
        separators.append(Separator(middle, children))
        return len(separators) - 1

    visit(np.arange(len(positions)))
    _known[key] = separators
    while len(_known) > _REMEMBERED:
        _known.popitem(last=False)
    return separators


def _cut(pattern: csr_array, positions: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """A separator of a part and the (at most two) parts it leaves."""
    if len(vertices) <= _LEAF:
        return vertices, []
    graph = pattern[vertices][:, vertices]
    centred = positions[vertices] - positions[vertices].mean(0)
    axes = np.linalg.eigh(centred.T @ centred).eigenvectors.T
    cuts = [_between(graph, centred @ axis, share) for axis in axes for share in _SHARES]
    middle = min(cuts, key=lambda cut: _cost(cut, len(vertices)))[0]
    if not middle.any():  # parts that share no element; a front needs a vertex all the same
        middle = np.arange(len(vertices)) == 0
    rest = np.flatnonzero(~middle)
    if len(rest) == 0:
        return vertices, []
    halves = _balanced(connected_components(graph[rest][:, rest])[1])
    return vertices[middle], [vertices[rest[half]] for half in halves]


def _between(graph: csr_array, height: np.ndarray, share: float) -> tuple[np.ndarray, int]:
    """Mask of the smallest set of vertices that separates the lower ``share`` from the rest, and how many lie below.

    Every edge across the cut needs one of its ends in the set: a least vertex cover of a bipartite graph, which is
    found from a largest matching (Koenig; Ashcraft and Liu, SIAM J. Matrix Anal. Appl. 19, 1998).
    """
    order = np.argsort(height, kind="stable")
    low, high = np.sort(order[: int(share * len(order))]), np.sort(order[int(share * len(order)) :])
    across = csr_array(graph[low][:, high])
    matched = maximum_bipartite_matching(across, perm_type="column")
    partner = np.full(len(high), -1)
    partner[matched[matched >= 0]] = np.flatnonzero(matched >= 0)
    from_low, from_high = np.zeros(len(low), bool), np.zeros(len(high), bool)
    waiting = np.flatnonzero((matched < 0) & (np.diff(across.indptr) > 0))
    while len(waiting):  # along alternating paths from unmatched vertices
        from_low[waiting] = True
        met = np.unique(across[waiting].indices)
        met = met[~from_high[met]]
        from_high[met] = True
        waiting = partner[met]
        waiting = waiting[(waiting >= 0) & ~from_low[waiting]]
    middle = np.zeros(len(height), bool)
    middle[low[(matched >= 0) & ~from_low]] = True
    middle[high[from_high]] = True
    return middle, int((~middle[low]).sum())


def _cost(cut: tuple[np.ndarray, int], count: int) -> float:
    """Size of a separator, larger by as much as the parts differ."""
    middle, below = cut
    size = int(middle.sum())
    above = count - size - below
    return size * (1 + abs(above - below) / max(above + below, 1))


def _balanced(label: np.ndarray) -> list[np.ndarray]:
    """Connected components dealt to two groups of nearly equal size; empty groups are left out."""
    sizes = np.bincount(label)
    group, weight = np.zeros(len(sizes), int), [0, 0]
    for component in np.argsort(-sizes).tolist():
        side = int(weight[1] < weight[0])
        group[component] = side
        weight[side] += int(sizes[component])
    return [half for half in (np.flatnonzero(group[label] == side) for side in (0, 1)) if len(half)]
