"""Local quadratics in time: positions, velocities, accelerations and noise out of measured tracks with holes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

REACH = 2
"""Frames on either side that a local quadratic uses; twice as many where holes leave fewer than three."""

_LEAST = 3  # a quadratic has three coefficients


@dataclass(frozen=True)
class LocalFit:
    """The local quadratic of each vertex at one frame; NaN where too little was seen.

    position [m], velocity [m/s] and acceleration [m/s^2], (V, 3) each; known (V,).
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """Whether the vertex was seen often enough, (V,)."""
        return np.asarray(np.isfinite(self.position).all(axis=-1))


def local_quadratic(vertices: np.ndarray, observed: np.ndarray, fps: float, frame: int, reach: int = REACH) -> LocalFit:
    """Least-squares quadratics through the frames around ``frame`` of tracks (T, V, 3), seen where ``observed`` (T, V).

    A vertex needs three frames within ``reach``, or within twice that, on both sides of the frame or at it.
    """
    near, wide = (_fit(vertices, observed, fps, frame, r) for r in (reach, 2 * reach))
    filled = [np.where(np.isfinite(a), a, b) for a, b in zip(near, wide, strict=True)]
    return LocalFit(*filled)


def _fit(
    vertices: np.ndarray, observed: np.ndarray, fps: float, frame: int, reach: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    span = slice(max(frame - reach, 0), min(frame + reach + 1, len(vertices)))
    time = np.arange(span.start, span.stop) - frame
    seen = observed[span].astype(float)
    basis = np.stack([np.ones_like(time, float), time, 0.5 * time**2], axis=-1)  # (n, 3)
    normal = np.einsum("tv,ti,tj->vij", seen, basis, basis)
    right = np.einsum("tv,ti,tvc->vic", seen, basis, np.nan_to_num(vertices[span]))
    inside = (seen[time <= 0].sum(0) > 0) & (seen[time >= 0].sum(0) > 0)
    good = (seen.sum(axis=0) >= _LEAST) & inside
    solved = np.full(right.shape, np.nan)
    if good.any():
        solved[good] = np.linalg.solve(normal[good], right[good])
    return solved[:, 0], solved[:, 1] * fps, solved[:, 2] * fps**2


def cubic_residuals(vertices: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Mean square (T - 4, V) [m^2], per coordinate, of what a cubic leaves of five consecutive frames.

    An unbiased estimate of the variance of noise that is independent from frame to frame, wherever the motion is no
    more than cubic over five frames (a quadratic leaves more of a real motion than noise of a millimetre does). NaN
    where one of the five was not seen.
    """
    if len(vertices) < 5:
        return np.full((0, vertices.shape[1]), np.nan)
    basis = np.arange(-2, 3)[:, None] ** np.arange(4)
    leftover = np.linalg.qr(basis, mode="complete")[0][:, 4]  # the one direction that no cubic reaches
    windows = np.lib.stride_tricks.sliding_window_view(np.where(observed[..., None], vertices, np.nan), 5, axis=0)
    return ((windows @ leftover) ** 2).mean(axis=-1)
