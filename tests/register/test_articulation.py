"""Derivatives of posed points against finite differences of the body model, and the pose prior against its own."""

from __future__ import annotations

import numpy as np
import pytest

from caphy.body.bundled import default_body
from caphy.register.articulation import POSE_UNKNOWNS, Figure, Placement
from caphy.register.pose_statistics import PoseStatistics, mirrored
from caphy.register.prior import PosePrior
from caphy.rotations import matrix_from_axis_angle

STEP = 1e-6


@pytest.fixture(scope="module")
def figure() -> Figure:
    rng = np.random.default_rng(1)
    body = default_body()
    return Figure.of(body, rng.standard_normal(10), 0.01 * rng.standard_normal(body.v_template.shape))


@pytest.fixture(scope="module")
def placement() -> Placement:
    rng = np.random.default_rng(2)
    return Placement.of(0.4 * rng.standard_normal((55, 3)), rng.standard_normal(3))


def test_a_placed_figure_is_where_the_body_model_puts_it(figure, placement):
    rest = figure.body.rest(figure.betas)[0]
    plain = Figure.of(figure.body, figure.betas).placed(placement)
    posed = figure.body.pose(placement.pose[None], placement.transl[None], figure.betas)[0]
    np.testing.assert_allclose(plain.vertices, posed, atol=1e-9)
    joints = figure.body.posed_joints(placement.pose[None], placement.transl[None], figure.betas)[0]
    np.testing.assert_allclose(plain.joints, joints, atol=1e-9)
    assert np.abs(figure.rest[0] - rest).max() > 0.01


def test_rows_are_the_derivatives_of_points_by_every_unknown(figure, placement):
    rng = np.random.default_rng(3)
    face = rng.integers(0, len(figure.body.faces), 120)
    share, direction = rng.dirichlet(np.ones(3), 120), rng.standard_normal((120, 3))
    placed = figure.placed(placement)
    rows = placed.rows(face, share, direction, True)
    assert rows.shape == (120, POSE_UNKNOWNS + 10)
    for k in range(rows.shape[1]):
        ends = []
        for sign in (1, -1):
            step, betas = np.zeros(POSE_UNKNOWNS), figure.betas.copy()
            if k < POSE_UNKNOWNS:
                step[k] = sign * STEP
            else:
                betas[k - POSE_UNKNOWNS] += sign * STEP
            other = Figure.of(figure.body, betas, figure.displacement).placed(placement.moved(step, placed.world))
            ends.append((other.points(face, share) * direction).sum(axis=1))
        np.testing.assert_allclose(rows[:, k], (ends[0] - ends[1]) / (2 * STEP), atol=1e-7)


def test_prior_residuals_have_the_derivatives_they_say(figure, placement):
    prior = PosePrior(matrix_from_axis_angle(0.3 * np.random.default_rng(4).standard_normal((22, 3))))
    world = figure.placed(placement).world
    value, slopes = prior.residuals(placement, world)
    for k in (0, 4, 17, 40, 65, 67):
        step = np.zeros(POSE_UNKNOWNS)
        step[k] = 1e-4
        ahead, behind = (prior.residuals(placement.moved(s * step, world), world)[0] for s in (1, -1))
        np.testing.assert_allclose(slopes[:, k], (ahead - behind) / 2e-4, atol=2e-3 * np.abs(slopes).max())
    assert np.isfinite(value).all()


def test_pose_statistics_know_no_left_or_right():
    rng = np.random.default_rng(5)
    poses = rng.standard_normal((30, 55, 3)) * 0.2 + 0.1
    found = PoseStatistics.over([poses])
    np.testing.assert_allclose(mirrored(found.mean.reshape(21, 3)), found.mean.reshape(21, 3), atol=1e-12)
    np.testing.assert_allclose(mirrored(mirrored(poses[0, 1:22])), poses[0, 1:22])
    assert PoseStatistics.bundled().covariance.shape == (63, 63)


def test_a_mirrored_pose_is_the_mirror_image():
    body, poses = default_body(), np.zeros((1, 55, 3))
    poses[0, 1:22] = 0.5 * np.random.default_rng(6).standard_normal((21, 3))
    other = np.zeros_like(poses)
    other[0, 1:22] = mirrored(poses[0, 1:22])
    one, two = (body.posed_joints(each)[0] for each in (poses, other))
    for left, right in ((20, 21), (7, 8), (21, 20), (15, 15)):
        np.testing.assert_allclose(one[left] * [-1, 1, 1], two[right], atol=0.002)
