"""Where points say that a cloth ends: its length and width, of which points within it know nothing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from caphy.garment.topology import boundary_loops

DEPTH = 0.05
"""How far inwards of a rim points are looked at [m]."""
FLAT = 0.005, 0.5
"""How far out of the plane of an edge's face points may lie: this [m], and so much more per distance from the edge.
Others belong to another edge, as where a corner is folded."""
FEWEST = 3
"""Points in the strip behind an edge without which it is not known where the cloth ends."""


@dataclass(frozen=True, eq=False)
class Rim:
    """The boundary edges of a mesh, loop after loop, each loop's in its order.

    Attributes:
        edges: vertices (E, 2), wound as their faces are.
        apex: the third vertex of each edge's face (E,).
        loop: which loop each edge belongs to (E,).
        length: of each edge at rest (E,) [m].
        near: which faces lie near each edge at rest (E, F).
    """

    edges: np.ndarray
    apex: np.ndarray
    loop: np.ndarray
    length: np.ndarray
    near: np.ndarray

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray) -> Rim:
        """Of a mesh at rest, vertices (V, 3) [m] and faces (F, 3)."""
        loops = boundary_loops(faces)
        edges = np.concatenate([np.stack([loop, np.roll(loop, -1)], 1) for loop in loops] or [np.zeros((0, 2), int)])
        third = {(f[k], f[(k + 1) % 3]): f[(k + 2) % 3] for f in np.asarray(faces).tolist() for k in range(3)}
        a, b = vertices[edges].transpose(1, 0, 2)
        length, middle = np.linalg.norm(b - a, axis=1), (a + b) / 2
        away = np.linalg.norm(middle[:, None] - vertices, axis=-1)[:, faces].min(axis=-1)
        return cls(
            edges,
            np.array([third[a, b] for a, b in edges.tolist()], dtype=int),
            np.repeat(np.arange(len(loops)), list(map(len, loops))),
            length,
            away < DEPTH + length[:, None],
        )

    @cached_property
    def neighbours(self) -> np.ndarray:
        """Pairs of edges (E, 2) that follow each other around a loop."""
        around = [np.flatnonzero(self.loop == loop) for loop in np.unique(self.loop)]
        pairs = [np.stack([index, np.roll(index, -1)], 1) for index in around]
        return np.concatenate([*pairs, np.zeros((0, 2), int)])

    @cached_property
    def _faces(self) -> np.ndarray:
        """Which faces lie near any edge at rest (F,)."""
        return np.logical_or.reduce(self.near)

    def frames(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Middles (..., E, 3) [m] of the edges of a cloth at x (..., V, 3) [m], unit vectors along them, and out of
        the cloth across them."""
        a, b, c = (x[..., index, :] for index in (*self.edges.T, self.apex))
        along = (b - a) / np.linalg.norm(b - a, axis=-1, keepdims=True)
        inward = (c - a) - ((c - a) * along).sum(-1, keepdims=True) * along
        return (a + b) / 2, along, -inward / np.linalg.norm(inward, axis=-1, keepdims=True)

    def enough(self, known: np.ndarray, share: float) -> np.ndarray:
        """Those of the ``known`` edges (E,) on whose loop at least a ``share`` of the length is known."""
        whole = np.bincount(self.loop, self.length)
        return known & (np.bincount(self.loop, self.length * known) >= share * whole)[self.loop]

    def ends(self, x: np.ndarray, cloud: np.ndarray, face: np.ndarray, noise: float) -> np.ndarray:
        """Where the cloth ends beside each edge (E, 3) [m]; NaN where too few points lie behind it.

        The outermost of n points that lie evenly in a strip is one gap, the strip over n, short of its end on average;
        noise carries it further out. Corrected for both this has no bias, and a standard deviation of about one gap.

        Args:
            x: about where the cloth is (V, 3) [m].
            cloud: points of it (N, 3) [m].
            face: the face nearest to each (N,).
            noise: standard deviation of a point's coordinate [m].
        """
        within = self._faces[face]
        cloud, face = cloud[within], face[within]
        middle, along, out = self.frames(x)
        beside, beyond = (axis @ cloud.T - (axis * middle).sum(1, keepdims=True) for axis in (along, out))
        half = 0.5 * np.linalg.norm(np.diff(x[self.edges], axis=1)[:, 0], axis=1)
        level = np.cross(along, out)
        aside = np.abs(level @ cloud.T - (level * middle).sum(1, keepdims=True))
        strip = self.near[:, face] & (np.abs(beside) <= half[:, None]) & (beyond > -DEPTH)
        strip &= aside <= FLAT[0] + 5 * noise + FLAT[1] * np.abs(beyond)
        count, outermost = strip.sum(1), np.where(strip, beyond, -DEPTH).max(axis=1, initial=-DEPTH)
        gap = (outermost + DEPTH) / np.maximum(count, 1)
        end = np.where(count >= FEWEST, outermost - reached(gap, noise), np.nan)
        return middle + end[:, None] * out


def reached(gap: np.ndarray, noise: float) -> np.ndarray:
    """How far beyond a line (E,) [m] the outermost point lies on average: behind it there is one point per gap (E,)
    [m], and the noise of each has a standard deviation of ``noise`` [m].

    Points beyond a place u (in units of the noise) are Poisson with mean noise / gap (phi(u) - u Phi(-u)).
    """
    if noise == 0:
        return -gap
    ratio, carried = _carried()
    return noise * np.interp(np.log(np.maximum(gap, 1e-12) / noise), ratio, carried) - gap


@cache
def _carried() -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of gaps over noise, and how far noise carries the outermost point further out, over the noise.

    It falls to nothing where gaps are wide, so that beyond the last the answer is that without noise.
    """
    from scipy.stats import norm

    ratio, u = np.geomspace(1e-3, 1e4, 400), np.linspace(-8, 8, 4001)
    none = np.exp(-(norm.pdf(u) - u * norm.sf(u)) / ratio[:, None])  # that no point lies beyond u
    without_noise = 8 - ratio * np.expm1(-8 / ratio)  # the same, summed over u
    return np.log(ratio), without_noise - np.trapezoid(none, u, axis=1)
