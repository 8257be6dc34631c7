"""What colour the surface has: skin, hair and shoes of a person, and the print of a garment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.body.model import BodyModel
from caphy.conventions import JOINT_NAMES

SKINS = ((0.91, 0.76, 0.66), (0.78, 0.58, 0.45), (0.55, 0.38, 0.28), (0.36, 0.24, 0.18))
HAIRS = ((0.15, 0.10, 0.08), (0.35, 0.22, 0.12), (0.62, 0.48, 0.28))
CLOTHS = (
    *((0.16, 0.27, 0.52), (0.55, 0.12, 0.16), (0.13, 0.40, 0.25), (0.85, 0.83, 0.78), (0.20, 0.21, 0.24)),
    *((0.80, 0.55, 0.15), (0.42, 0.30, 0.50), (0.30, 0.48, 0.60)),
)


@dataclass(frozen=True, eq=False)
class Print:
    """The print of a garment: a ground colour, and stripes or a check of a second one. sRGB in 0 to 1."""

    ground: np.ndarray
    second: np.ndarray
    period: tuple[float, float]
    """Width of a repeat round the body and along it [m]; infinite for none."""

    def colours(self, rest: np.ndarray) -> np.ndarray:
        """Colours (N, 3) of points (N, 3) [m] of the T-posed garment."""
        stripe = np.zeros(len(rest), dtype=bool)
        for axis, period in zip((0, 1), self.period, strict=True):
            if np.isfinite(period):
                stripe ^= (rest[:, axis] / period) % 1.0 < 0.3
        return np.where(stripe[:, None], self.second, self.ground)


def random_prints(random: np.random.Generator, labels: list[str]) -> dict[str, Print]:
    """A print for each garment, of different colours; one in three is plain."""
    chosen = random.permutation(len(CLOTHS))
    prints = {}
    for i, label in enumerate(labels):
        ground, other = np.array(CLOTHS[chosen[i]]), np.array(CLOTHS[chosen[i + len(labels)]])
        kind = random.integers(3)
        period = [(np.inf, np.inf), (np.inf, 0.06), (0.08, 0.08)][kind]
        prints[label] = Print(ground, 0.6 * ground + 0.4 * other, period)
    return prints


def body_colours(body: BodyModel, random: np.random.Generator) -> np.ndarray:
    """Colours (V, 3) of a body's vertices: skin with blotches, hair on the head, shoes on the feet."""
    vertices = body.v_template
    skin, hair = np.array(SKINS[random.integers(len(SKINS))]), np.array(HAIRS[random.integers(len(HAIRS))])
    shoe = np.array([(0.1, 0.1, 0.1), (0.7, 0.7, 0.68), (0.35, 0.22, 0.15)][random.integers(3)])
    waves = random.normal(size=(8, 3)) * 40
    blotch = np.cos(vertices @ waves.T + random.uniform(0, 6.3, 8)).mean(axis=1)
    colours = skin * (1 + 0.05 * blotch[:, None])
    head = _weight(body, "head", "jaw") > 0.5
    top = vertices[:, 1] > np.quantile(vertices[head, 1], 0.72)
    behind = vertices[:, 2] < np.median(vertices[head, 2]) - 0.01
    high = vertices[:, 1] > np.quantile(vertices[head, 1], 0.35)
    colours[head & (top | (behind & high))] = hair
    colours[_weight(body, "ankle", "foot") > 0.6] = shoe
    return np.clip(colours, 0, 1)


def _weight(body: BodyModel, *parts: str) -> np.ndarray:
    return body.weights[:, [j for j, n in enumerate(JOINT_NAMES) if any(part in n for part in parts)]].sum(axis=1)
