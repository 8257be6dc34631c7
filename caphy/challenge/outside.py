"""Forces that no effect of the library states, to see whether a diagnosis admits that it does not know them.

Each is (positions (V, 3) [m], velocities (V, 3) [m/s], time [s], cloth) -> forces (V, 3) [N].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from caphy.effects.cloth import Cloth

OutsideForce = Callable[[np.ndarray, np.ndarray, float, Cloth], np.ndarray]


def attraction(x: np.ndarray, v: np.ndarray, time: float, cloth: Cloth) -> np.ndarray:
    """A pull towards a point beside the cloth, falling off with the square of the distance."""
    away = np.array([0.25, 0.1, 0.3]) - x
    distance = np.sqrt((away**2).sum(1, keepdims=True) + 0.05**2)
    return cloth.mass[:, None] * 0.35 * away / distance**3


def swirl(x: np.ndarray, v: np.ndarray, time: float, cloth: Cloth) -> np.ndarray:
    """A push round an upright axis through the cloth, whichever way the cloth faces there."""
    arm = x - np.array([0.05, 0.0, 0.0])
    around = np.stack([arm[:, 2], 0 * arm[:, 0], -arm[:, 0]], 1)
    return cloth.mass[:, None] * 3.0 * around / (0.1 + np.linalg.norm(around, axis=1, keepdims=True))


def stripes(x: np.ndarray, v: np.ndarray, time: float, cloth: Cloth) -> np.ndarray:
    """A push upwards and to one side that grows along the weft, as if threads were charged more and more."""
    along = cloth.vertices[:, 0] - cloth.vertices[:, 0].mean()
    return cloth.mass[:, None] * np.outer(along / 0.2, (1.5, 1.5, -1.0))


def shaker(x: np.ndarray, v: np.ndarray, time: float, cloth: Cloth) -> np.ndarray:
    """Something sewn into one place of the cloth that pulls to and fro at 2.5 Hz."""
    within = np.quantile(cloth.vertices, 0.3, axis=0)  # of a skirt that is in the air
    place = cloth.vertices[((cloth.vertices - within) ** 2).sum(1).argmin()]
    near = np.exp(-((cloth.vertices - place) ** 2).sum(1) / (2 * 0.05**2))
    return np.outer(cloth.mass * near, np.array([3.0, 1.0, 6.0]) * np.sin(2 * np.pi * 2.5 * time))


def magnetic(x: np.ndarray, v: np.ndarray, time: float, cloth: Cloth) -> np.ndarray:
    """A push across the velocity, as on a charge in a magnetic field: it does no work."""
    return cloth.mass[:, None] * np.cross(v, (0.0, 6.0, 2.0))


def layer(x: np.ndarray, v: np.ndarray, time: float, cloth: Cloth) -> np.ndarray:
    """A lift that only cloth below a height feels, as from warm air close to the floor."""
    low = 1 / (1 + np.exp((x[:, 1] - x[:, 1].mean()) / 0.03))
    return np.outer(cloth.mass * low, (0.0, 2.5, 0.0))


FORCES: Mapping[str, OutsideForce] = {
    force.__name__: force for force in (attraction, swirl, stripes, shaker, magnetic, layer)
}
"""By name."""
