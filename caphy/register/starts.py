"""Where to start from: the given estimate first, then plain poses facing every way; the best of them wins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caphy.body.surface import Surface
from caphy.conventions import JOINT_COUNT, JOINT_NAMES
from caphy.register.articulation import Figure, Placement
from caphy.register.cloud import Cloud
from caphy.register.coarse import WIDTHS, CoarseFit, coarse_fit
from caphy.register.prior import PosePrior
from caphy.register.semantic import MARGIN

FAR = 0.03
"""Distance [m] at which a point counts as unexplained."""
DOUBTFUL = 0.06
"""Share of unexplained points above which other starts are tried."""
HEADINGS = np.radians([0.0, 90.0, 180.0, 270.0])
ARMS_DOWN = np.radians((0.0, 55.0))
"""How far the upper arms hang below the horizontal in the plain poses: T and A [rad]."""
CHECKED_POINTS = 1500


@dataclass(frozen=True, eq=False)
class FirstFit:
    """The best coarse fit of a scan.

    Attributes:
        fit: pose and shape.
        far: share of the scan's points that lie far off.
        unseen: share of the body's head, forearms and feet that lie where the scan shows nothing.
        estimated: whether it came from the estimate, rather than from a plain pose that explains more.
    """

    fit: CoarseFit
    far: float
    unseen: float
    estimated: bool

    @property
    def unexplained(self) -> float:
        """Both shares."""
        return self.far + self.unseen


def first_fit(figure: Figure, surface: Surface, cloud: Cloud, start: Placement | None) -> FirstFit:
    """The best coarse fit of a cloud.

    Args:
        start: an estimate that may be 20 degrees off in every joint, or none.
    """
    fits = []
    if start is not None:
        fit = coarse_fit(figure, cloud, start, PosePrior(start.rotations[:22]))
        fits.append(FirstFit(fit, *_unexplained(fit, figure, surface, cloud), True))
        if fits[0].unexplained < DOUBTFUL:
            return fits[0]
    rough = [coarse_fit(figure, cloud, plain, PosePrior(), WIDTHS[:5]) for plain in plain_poses()]
    for near in sorted(rough, key=lambda fit: fit.misfit)[:2]:
        fit = coarse_fit(figure, cloud, near.placement, PosePrior())
        fits.append(FirstFit(fit, *_unexplained(fit, figure, surface, cloud), False))
    return min(fits, key=lambda fit: fit.unexplained)


def plain_poses() -> list[Placement]:
    """T- and A-pose, facing the four ways."""
    found = []
    for heading in HEADINGS:
        for down in ARMS_DOWN:
            pose = np.zeros((JOINT_COUNT, 3))
            pose[0, 1] = heading
            for side, sign in (("left", -1.0), ("right", 1.0)):
                pose[JOINT_NAMES.index(f"{side}_shoulder"), 2] = sign * down
            found.append(Placement.of(pose, np.zeros(3)))
    return found


def _unexplained(fit: CoarseFit, figure: Figure, surface: Surface, cloud: Cloud) -> tuple[float, float]:
    """Shares (0 to 1) of points that lie far off, skin off the body or cloth inside it, and of body unseen."""
    cloud = cloud.thinned(CHECKED_POINTS)
    vertices = Figure(figure.body, fit.betas, figure.displacement).placed(fit.placement).vertices
    distance = surface.nearest(cloud.points, vertices).distance
    off = np.where(cloud.skin, np.abs(distance), np.maximum(MARGIN - distance, 0.0))
    return float((off > FAR).mean()), _unseen_limbs(vertices, figure, cloud)


def _unseen_limbs(vertices: np.ndarray, figure: Figure, cloud: Cloud) -> float:
    """Share of limb and head vertices farther than 8 cm from any point of the scan: a limb laid where none is."""
    from scipy.spatial import KDTree

    limbs = figure.body.weights[:, list(_LIMBS)].sum(axis=1) > 0.5
    return float((KDTree(cloud.points).query(vertices[limbs])[0] > 0.08).mean())


_LIMBS = [
    place
    for place, name in enumerate(JOINT_NAMES)
    if name in ("head", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_ankle", "right_ankle")
]
