"""From labels of pixels to labels of vertices: votes of all views that show a vertex, then smoothing (CaPhy, 3.1)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from caphy.scan.parsers import LABEL_COUNT, Parser
from caphy.scan.scan import UNKNOWN, Scan
from caphy.scan.views import SIZE, ScanView, scan_views

ROUNDS: Final = 12
"""Times that each vertex hears its neighbours: labels are smoothed over about three edges."""
TRUST: Final = 0.25
"""Share of a vertex's own votes in what it holds after each round."""
COLOUR_SCALE: Final = 24.0
"""Difference of colour at which neighbours hardly listen to each other [of 255]."""
ISLAND: Final = 0.002
"""Patches of one label smaller than this share of the scan take the label around them."""


def segment(scan: Scan, parser: Parser, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Labels (V,) uint8 of a scan by a parser that looks at 32 pictures of it."""
    return smoothed_labels(scan, votes(scan, parser, scan_views(scan, size)))


def given_labels(scan: Scan) -> np.ndarray:
    """Labels (V,) uint8 that came with a scan, with gaps filled and islands removed."""
    if scan.labels is None:
        raise scan.error("has no labels; add them, or let 'caphy segment' make them with --parser colour")
    if (scan.labels == UNKNOWN).all():
        raise scan.error("its labels are empty: every vertex is unknown")
    count = np.zeros((len(scan.vertices), LABEL_COUNT))
    known = np.flatnonzero(scan.labels != UNKNOWN)
    count[known, scan.labels[known]] = 1.0
    filled = _filled(count, _neighbour_mean(scan))
    labels = np.where(filled.sum(axis=1) > 1e-9, filled.argmax(axis=1), UNKNOWN).astype(np.uint8)
    return without_islands(scan, labels)


def votes(scan: Scan, parser: Parser, views: Iterable[ScanView]) -> np.ndarray:
    """Votes (V, 3) of the views that show each vertex, one each."""
    count = np.zeros((len(scan.vertices), LABEL_COUNT))
    for view in views:
        vertex, row, column = view.visible()
        label = parser.parse(view)[row, column]
        said = label != UNKNOWN
        np.add.at(count, (vertex[said], label[said]), 1.0)
    return count


def smoothed_labels(scan: Scan, count: np.ndarray) -> np.ndarray:
    """Labels (V,) uint8 of votes (V, 3): neighbours of like colour agree, small islands go, gaps are filled.

    Vertices that no view shows take what their neighbours hold; pieces of which nobody knows anything stay
    :data:`UNKNOWN`.
    """
    total = count.sum(axis=1, keepdims=True)
    own = count / np.maximum(total, 1.0)
    spread = _neighbour_mean(scan)
    held = own
    trust = TRUST * np.minimum(total / 3, 1.0)  # three views make a witness
    for _ in range(ROUNDS):
        held = trust * own + (1 - trust) * (spread @ held)
    held = _filled(held, spread)
    labels = np.where(held.sum(axis=1) > 1e-9, held.argmax(axis=1), UNKNOWN).astype(np.uint8)
    return without_islands(scan, labels)


def _neighbour_mean(scan: Scan):
    """Sparse (V, V): mean over neighbours, those of another colour counting less."""
    from scipy.sparse import coo_matrix, diags

    a, b = _edges(scan.faces).T
    weight = np.ones(len(a))
    if scan.colours is not None:
        gap = np.linalg.norm(scan.colours[a].astype(float) - scan.colours[b], axis=1)
        weight = 0.02 + np.exp(-((gap / COLOUR_SCALE) ** 2))
    size = len(scan.vertices)
    graph = coo_matrix((np.tile(weight, 2), (np.r_[a, b], np.r_[b, a])), (size, size)).tocsr()
    return diags(1 / np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1e-12)) @ graph


def _filled(held: np.ndarray, spread) -> np.ndarray:
    """Shares (V, 3) with those of nobody taken from neighbours, as far as the mesh reaches."""
    for _ in range(400):
        empty = held.sum(axis=1) < 1e-9
        if not empty.any():
            break
        more = spread[empty] @ held
        if not more.any():
            break
        held[empty] = more / np.maximum(more.sum(axis=1, keepdims=True), 1e-12)
    return held


def without_islands(scan: Scan, labels: np.ndarray) -> np.ndarray:
    """Labels (V,) in which patches smaller than :data:`ISLAND` have what most vertices along their edge have."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    labels = labels.copy()
    edges = _edges(scan.faces)
    least = ISLAND * len(np.unique(scan.faces))
    for _ in range(3):
        a, b = edges[labels[edges[:, 0]] == labels[edges[:, 1]]].T
        graph = coo_matrix((np.ones(len(a)), (a, b)), (len(labels),) * 2)
        count, patch = connected_components(graph, directed=False)
        small = np.bincount(patch, minlength=count) < least
        border = edges[labels[edges[:, 0]] != labels[edges[:, 1]]]
        border = np.concatenate([border, border[:, ::-1]])
        border = border[small[patch[border[:, 0]]] & (labels[border[:, 1]] != UNKNOWN)]
        if not len(border):
            break
        around = np.zeros((count, LABEL_COUNT))
        np.add.at(around, (patch[border[:, 0]], labels[border[:, 1]]), 1.0)
        changed = small & around.any(axis=1)
        labels = np.where(changed[patch], around.argmax(axis=1)[patch], labels).astype(np.uint8)
    return labels


def _edges(faces: np.ndarray) -> np.ndarray:
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0)
