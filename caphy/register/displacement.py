"""The skin's displacement from the shape model, shared by all scans: one sparse linear least squares."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, eye, kron
from scipy.sparse.linalg import splu

from caphy.body.model import BodyModel
from caphy.garment import topology
from caphy.garment.threads import neighbour_average
from caphy.register.articulation import PlacedFigure
from caphy.register.semantic import Matches

SMOOTH = 1.0
"""Weight of a vertex's difference from its neighbours' mean, against one point a vertex and scan."""
SMALL = 0.004
"""Weight of the displacement itself."""


def displacement_step(body: BodyModel, now: np.ndarray, found: Iterable[tuple[PlacedFigure, Matches]]) -> np.ndarray:
    """The displacement (V, 3) [m] that best explains all matches, being at ``now`` (V, 3) when they were found."""
    size = 3 * len(now)
    matrix, right, scans = csc_matrix((size, size)), np.zeros(size), 0
    for placed, matches in found:
        rows, value, weight = _rows(placed, matches, now)
        weighted = rows.multiply(weight[:, None]).tocsc()
        matrix = matrix + (weighted.T @ rows).tocsc()
        right += weighted.T @ value
        scans += 1
    solved = splu((matrix / max(scans, 1) + _regular(body)).tocsc()).solve(right / max(scans, 1))
    return solved.reshape(now.shape)


def _rows(placed: PlacedFigure, matches: Matches, now: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
    """Linear equations of the displacement: rows (N, 3 V), values (N,) [m], weights (N,)."""
    used = np.flatnonzero(matches.weight > 1e-4)
    corners = placed.figure.body.faces[matches.face[used]]
    turned = np.einsum("nkij,ni->nkj", placed.blended[corners][..., :3], matches.normal[used])
    entries = matches.share[used][..., None] * turned  # (N, corner, axis): how a corner's displacement lifts the point
    columns = 3 * corners[..., None] + np.arange(3)
    index = np.broadcast_to(np.arange(len(used))[:, None, None], entries.shape)
    shape = (len(used), now.size)
    rows = coo_matrix((entries.ravel(), (index.ravel(), columns.ravel())), shape).tocsc()
    return rows, matches.residual[used] + rows @ now.ravel(), matches.weight[used]


@lru_cache(maxsize=2)
def _regular(body: BodyModel) -> Any:
    """What keeps the displacement smooth and small (3 V, 3 V)."""
    count = len(body.v_template)
    rough = eye(count) - neighbour_average(topology.edges(body.faces), count)
    return kron(SMOOTH * rough.T @ rough + SMALL * eye(count), eye(3)).tocsc()
