"""The moving body as cloth sees it, and cloth resting on it."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence
from caphy.kept import Kept
from caphy.measure.mesh_body import MeshBody
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton, Report
from caphy.solve.preroll import preroll_poses
from caphy.solve.rollout import AT_ONCE, State, Trajectory, simulate
from caphy.solve.statics import drape_on_body

DENSITY = 0.2
RESTING = 0.004 - np.sqrt(DENSITY * 9.81 / 3e8)
"""Height of cloth on a plane: the contact pressure 3 k d^2 carries rho g."""


def sliding(turn=0.0, speed=0.6, frames=7, fps=30.0):
    poses = np.zeros((frames, 55, 3))
    poses[:, 0, 1] = turn * np.arange(frames)
    transl = np.outer(np.arange(frames) / fps, [speed, 0, 0])
    return PoseSequence(poses, transl, fps)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def potential_of(garment, **effects):
    model = Model(
        DENSITY, {"strain_stvk": {}, "bending": {}, "gravity": {}, "inertia": {}, "body_contact": {}, **effects}
    )
    return Potential(model, Cloth.of(garment, DENSITY))


def test_state_of_a_sliding_box(box_body, mat):
    motion = BodyMotion(box_body, sliding(), mat)
    time = 3.4 / 30
    x = motion.anchors(np.array([time]))[0]
    np.testing.assert_allclose(x, mat.vertices + np.array([0.6 * time, 0, 0]), atol=1e-12)
    state = motion.state(time, x, 1 / 30)
    np.testing.assert_allclose(state.normal, np.broadcast_to([0, 1, 0], x.shape), atol=1e-9)
    np.testing.assert_allclose(state.velocity, np.broadcast_to([0.6, 0, 0], x.shape), atol=1e-9)
    np.testing.assert_allclose(state.point, x - [0, 0.01, 0], atol=1e-9)
    np.testing.assert_allclose(state.anchor, x)


def test_between_frames_limbs_turn_rigidly(box_body, mat):
    """Half-way through a turn of 0.8 rad the box is turned by 0.4 rad and keeps its size; a lerp would shrink it."""
    motion = BodyMotion(box_body, sliding(turn=0.8, speed=0.0), mat)
    (half,) = motion.vertices(np.array([0.5 / 30]))
    sizes = [
        np.linalg.norm(np.diff(box[box_body.faces[:, [0, 1, 2, 0]]], axis=1), axis=2)
        for box in (half, box_body.v_template)
    ]
    np.testing.assert_allclose(*sizes, atol=1e-12)
    c, s = np.cos(0.4), np.sin(0.4)
    turned = box_body.v_template @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    assert np.abs(half - turned).max() < 1e-3 * np.abs(turned).max()


def test_between_frames_a_swinging_limb_is_where_it_swings(box_body, mat):
    """Two swings a second through half a turn each way, past where quaternions change sign, seen at 30 Hz.

    Straight from frame to frame it would be up to 22 mrad off.
    """
    frames, times = np.arange(31) / 30, np.linspace(0.1, 0.9, 400)
    poses = np.zeros((31, 55, 3))
    poses[:, 18, 2] = wrapped(3.0 + np.sin(4 * np.pi * frames))
    motion = BodyMotion(box_body, PoseSequence(poses, np.outer(np.cos(4 * np.pi * frames), [0.1, 0, 0]), 30.0), mat)
    seen, transl = motion.pose(times)
    off = wrapped(seen[:, 18, 2] - 3.0 - np.sin(4 * np.pi * times))
    assert np.abs(off).max() < 1e-3
    assert np.abs(transl[:, 0] - 0.1 * np.cos(4 * np.pi * times)).max() < 1e-4


@pytest.mark.parametrize("measured", [False, True])
def test_only_moved_points_are_looked_for_again(box_body, mat, measured):
    """Answers are those of a fresh body, wherever some of the points have gone and whatever the time was before."""

    def fresh():
        motion = BodyMotion(box_body, sliding(turn=0.3), mat)
        return MeshBody(motion.vertices(motion.times), box_body.faces, motion.fps) if measured else motion

    motion = fresh()
    rng = np.random.default_rng(6)
    x = mat.vertices + 0.1 * rng.normal(size=mat.vertices.shape)
    for time, share in ((0.0, 1.0), (0.0, 0.3), (0.0, 0.0), (0.1, 0.0), (0.1, 0.5)):
        x = x + 0.3 * rng.normal(size=x.shape) * (rng.random(len(x)) < share)[:, None]
        found, expected = motion.nearest(time, x), fresh().nearest(time, x)
        for name in ("point", "normal", "distance"):  # on an edge either face will do
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)


def test_cloth_on_the_body_is_carried_along(box_body, mat):
    motion = BodyMotion(box_body, sliding(turn=0.3), mat)
    x = motion.anchors(np.array([0.0]))[0] - [0, 0.0099, 0]
    guess = motion.carried(x, np.full_like(x, 9.0), 0.0, 0.1)
    expected = motion.anchors(np.array([0.1]))[0] - [0, 0.0099, 0]
    np.testing.assert_allclose(guess, expected, atol=0.03)


def test_cloth_rests_where_contact_carries_its_weight(box_body, mat):
    motion = BodyMotion(box_body, sliding()[:1], mat)
    x, report = drape_on_body(Newton(potential_of(mat), tolerance=1e-8), motion)
    assert report.converged
    np.testing.assert_allclose(x[:, 1], RESTING, rtol=1e-3)


def test_dropped_cloth_stays_on_top(box_body, mat):
    """A fall at 10 m/s, a third of a metre per frame, onto a box 0.4 m thick: no tunnelling, no explosion."""
    motion = BodyMotion(box_body, sliding(speed=0.0, frames=12), mat)
    x = torch.from_numpy(mat.vertices + np.array([0, 0.3, 0]))
    start = State(0.0, x, torch.tensor([0.0, -10.0, 0.0], dtype=torch.float64).expand_as(x))
    trajectory = simulate(potential_of(mat), motion, start)
    assert trajectory.converged.all()
    assert trajectory.positions[:, :, 1].min() > -0.001
    assert np.isfinite(trajectory.positions).all()


def test_without_friction_the_box_slides_away_underneath(box_body, mat):
    motion = BodyMotion(box_body, sliding(speed=0.5), mat)
    x = torch.from_numpy(mat.vertices * [1, 0, 1] + [0, RESTING, 0])
    trajectory = simulate(potential_of(mat), motion, State(0.0, x, torch.zeros_like(x)))
    np.testing.assert_allclose(trajectory.positions[-1], x, atol=1e-4)
    assert trajectory.residual.max() <= 5e-5


def test_trajectory_file(box_body, mat, tmp_path):
    motion = BodyMotion(box_body, sliding(frames=3), mat)
    x = torch.from_numpy(mat.vertices)
    trajectory = simulate(potential_of(mat), motion, State(0.0, x, torch.zeros_like(x)))
    trajectory.save(tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz", allow_pickle=False) as file:
        np.testing.assert_allclose(file["positions"], trajectory.positions, atol=1e-6)
        assert file["converged"].all() and file["fps"] == 30


def test_a_simulation_that_is_stopped_goes_on_where_it_was(box_body, mat, tmp_path):
    motion, frames = BodyMotion(box_body, sliding(turn=0.1, frames=2 * AT_ONCE + 9), mat), []
    whole = simulate(potential_of(mat), motion)

    def until(last: int) -> Callable[[int, int], None]:
        def stop(done: int, total: int) -> None:
            frames.append(done)
            if done > last:
                raise KeyboardInterrupt

        return stop

    kept = Kept(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        simulate(potential_of(mat), motion, progress=until(AT_ONCE + 5), kept=kept)
    frames.clear()
    again = simulate(potential_of(mat), motion, progress=until(1000), kept=kept)
    assert frames[:2] == [AT_ONCE + 1, AT_ONCE + 2]
    np.testing.assert_array_equal(again.positions, whole.positions)
    np.testing.assert_array_equal(again.velocities, whole.velocities)
    assert again.reports == whole.reports
    frames.clear()
    assert simulate(potential_of(mat), motion, progress=until(1000), kept=kept).reports == whole.reports
    assert frames == [AT_ONCE + 1, 2 * AT_ONCE + 1, 2 * AT_ONCE + 9]
    faster = BodyMotion(box_body, sliding(turn=0.2, frames=2 * AT_ONCE + 9), mat)
    assert np.abs(simulate(potential_of(mat), faster, kept=kept).positions - whole.positions).max() > 1e-3


def test_start_of_the_wrong_size_is_refused(box_body, mat):
    motion = BodyMotion(box_body, sliding(), mat)
    x = torch.zeros(5, 3, dtype=torch.float64)
    with pytest.raises(CaphyError, match=r"positions \(36, 3\), got \(5, 3\)"):
        simulate(potential_of(mat), motion, State(0.0, x, x))


def test_preroll_arrives_with_the_motion():
    """Last pose and speed of the way equal the motion's first; the first pose is the T-pose, heading kept."""
    rng = np.random.default_rng(0)
    poses = np.repeat(rng.normal(size=(1, 55, 3)), 2, axis=0)
    poses[1, :, 0] += 0.05
    sequence = PoseSequence(poses, np.array([[0, 1, 0], [0.05, 1, 0]]), 30.0)
    way = preroll_poses(sequence)
    np.testing.assert_allclose(way.poses[-1], poses[0], atol=1e-12)
    np.testing.assert_allclose(way.poses[0, 1:], 0, atol=1e-9)
    np.testing.assert_allclose(way.poses[0, 0], way.poses[-1, 0], atol=0.5)
    np.testing.assert_allclose(np.diff(way.transl, axis=0), np.broadcast_to([0.05, 0, 0], (30, 3)), atol=1e-12)


def test_the_first_frame_is_as_good_as_the_step_that_led_there(tmp_path):
    """Of a start that is given nothing is known, and the first frame counts as it is."""
    ended = Report(False, 200, 26.0, "too many iterations"), Report(True, 3, 1e-9, "converged")
    still = np.zeros((2, 4, 3))
    failed = Trajectory(still, still, 30.0, (ended, ended[1:]))
    assert (failed.converged.tolist(), failed.iterations.tolist(), failed.residual.tolist()) == (
        [False, True], [203, 3], [26.0, 1e-9],
    )  # fmt: skip
    failed.save(tmp_path / "o.npz")
    with np.load(tmp_path / "o.npz") as saved:
        assert saved["converged"].tolist() == [False, True] and saved["residual"][0] == 26
    given = Trajectory(still, still, 30.0, ((), ended[1:]))
    assert given.converged.all() and given.residual[0] == 0
