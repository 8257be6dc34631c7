"""What is known of a pose before looking: how bodies are posed, and what an estimator said."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from caphy.conventions import BODY_JOINT_COUNT, JOINT_PARENTS
from caphy.register.articulation import POSE_UNKNOWNS, Placement
from caphy.register.pose_statistics import PoseStatistics
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle

ESTIMATE_SPREAD = np.radians(20.0) / np.sqrt(3)
"""Standard deviation of an estimated joint rotation about each axis [rad]: 20 degrees in all."""
WIDENED = 1.3
"""How much wider than in the clips poses may be."""
LEAST_SPREAD = np.radians(2.0)
_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class PosePrior:
    """A Gaussian over all joints' rotation vectors, and one about an estimate where there is one.

    It decides what a scan leaves open: how a bend of the back is shared by its joints, how far a straight arm is
    turned about itself.
    """

    estimate: np.ndarray | None = None
    """Rotations (22, 3, 3) of an estimate, or none."""

    def residuals(self, placement: Placement, world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (M,) in standard deviations, and their derivatives (M, 69) by the step of :meth:`Placement.moved`.

        Args:
            world: world rotations (55, 3, 3) of the joints.
        """
        own = placement.rotations[:BODY_JOINT_COUNT]
        above = np.concatenate([np.eye(3)[None], world[list(JOINT_PARENTS[1:BODY_JOINT_COUNT])]])
        turned = [above.transpose(0, 2, 1) @ matrix_from_axis_angle(_STEP * a) @ above @ own for a in np.eye(3)]
        value, slopes = self._from_usual(own, turned)
        if self.estimate is None:
            return value, slopes
        base = self._from_estimate(own)
        blocks = np.stack([(self._from_estimate(part) - base) / _STEP for part in turned], axis=-1)
        return np.append(value, base), np.concatenate([slopes, _by_joint(blocks)])

    def _from_usual(self, own: np.ndarray, turned: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        mean, whiten = _usual()
        vector = axis_angle_from_matrix(own[1:])
        blocks = np.stack([(axis_angle_from_matrix(part[1:]) - vector) / _STEP for part in turned], axis=-1)
        slopes = np.zeros((vector.size, POSE_UNKNOWNS))
        slopes[:, 3 : 3 + vector.size] = _by_joint(blocks)[:, : vector.size]
        return whiten @ (vector.ravel() - mean), whiten @ slopes

    def _from_estimate(self, rotations: np.ndarray) -> np.ndarray:
        assert self.estimate is not None
        return axis_angle_from_matrix(self.estimate.transpose(0, 2, 1) @ rotations) / ESTIMATE_SPREAD


def _by_joint(blocks: np.ndarray) -> np.ndarray:
    """Derivatives (3 K, 69) of values (K, 3) that each depend on their own joint's turn only, given (K, 3, 3)."""
    rows = np.zeros((len(blocks), 3, POSE_UNKNOWNS))
    for joint, block in enumerate(blocks):
        rows[joint, :, 3 * joint : 3 * joint + 3] = block
    return rows.reshape(-1, POSE_UNKNOWNS)


@lru_cache(maxsize=1)
def _usual() -> tuple[np.ndarray, np.ndarray]:
    """Mean (63,) [rad] and whitening matrix (63, 63) of the bundled statistics, widened."""
    known = PoseStatistics.bundled()
    covariance = WIDENED**2 * known.covariance + LEAST_SPREAD**2 * np.eye(len(known.mean))
    return known.mean, np.linalg.inv(np.linalg.cholesky(covariance))
