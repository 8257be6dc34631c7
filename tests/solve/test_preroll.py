"""Whether a start converged is known, and said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_body_motion import potential_of, sliding

from caphy.commands.simulate import _dressed
from caphy.errors import CaphyError
from caphy.kept import Kept
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import ImplicitEuler
from caphy.solve.newton import Newton
from caphy.solve.preroll import dressed, preroll_poses, start_state
from caphy.solve.rollout import AT_ONCE, simulate


def test_the_way_to_a_start_tells_whether_it_converged(box_body, mat):
    motion = BodyMotion(box_body, sliding(turn=0.3), mat)
    state, reports = dressed(Newton(potential_of(mat)), motion)
    assert len(reports) == 30 and all(report.converged for frame in reports for report in frame)
    again = start_state(Newton(potential_of(mat)), motion)
    np.testing.assert_array_equal(again.x, state.x)
    np.testing.assert_array_equal(again.v, state.v)
    _, broken_off = dressed(Newton(potential_of(mat), max_iterations=1), motion)
    assert not all(report.converged for frame in broken_off for report in frame)


def test_simulate_says_that_its_start_did_not_converge(box_body, mat, tmp_path, capsys, monkeypatch):
    """Also when the start was kept from a run that was stopped."""
    motion = BodyMotion(box_body, sliding(turn=0.3), mat)
    _dressed(potential_of(mat), motion, Kept())
    assert capsys.readouterr().out == ""
    minimise = Newton.minimise

    def gives_up(self, *given, **more):
        x, report = minimise(self, *given, **more)
        return x, replace(report, converged=False, residual=0.25)

    monkeypatch.setattr(Newton, "minimise", gives_up)
    first, ended = _dressed(potential_of(mat), motion, Kept(tmp_path))
    assert ended and not any(report.converged for report in ended)
    said = capsys.readouterr().out
    assert "30 of 30 frames on the way to the start did not converge; largest force left 2.5e-01 N" in said
    monkeypatch.setattr(Newton, "minimise", minimise)
    again, told = _dressed(potential_of(mat), motion, Kept(tmp_path))
    np.testing.assert_array_equal(again.x, first.x)
    assert told == ended
    assert capsys.readouterr().out == said


def test_time_runs_on_from_the_way_into_the_motion(box_body, mat, monkeypatch):
    """A gust that swings would leap in between."""
    advance, ends = ImplicitEuler.advance, []

    def noted(self, state, dt, solve):
        ends.append(state.time + dt)
        return advance(self, state, dt, solve)

    monkeypatch.setattr(ImplicitEuler, "advance", noted)
    state, _ = dressed(Newton(potential_of(mat)), BodyMotion(box_body, sliding(turn=0.3), mat))
    np.testing.assert_allclose(ends, np.arange(-29, 1) / 30, atol=1e-12)
    assert state.time == 0.0


def test_a_first_step_that_is_a_leap_is_named_as_one():
    """Not as coordinates in millimetres, which its speed took the way to the start to."""
    poses = sliding(frames=4)
    poses = replace(poses, transl=poses.transl + np.array([[0.0], [50], [50], [50]]) * [1, 0, 0])
    with pytest.raises(CaphyError, match=r"from its first frame to its second the body leaps by 50 m \(1501 m/s\)"):
        preroll_poses(poses)


def test_what_was_asked_for_before_does_not_matter_once_forgotten(box_body, mat):
    """Points as near to two faces: which one is told hangs on the last answer, and a resumed motion has none."""
    motion = BodyMotion(box_body, sliding(speed=0.0), mat)
    corners = motion.vertices(np.zeros(1))[0][box_body.faces]
    at = corners[:, :2].mean(axis=1)
    first = motion.nearest(0.0, at)
    beside = motion.nearest(0.1, 0.9 * at + 0.1 * corners.mean(axis=1))
    assert (beside.face != first.face).any() and (motion.nearest(0.0, at).face == beside.face).all()
    motion.forget()
    for one, two in zip(first, motion.nearest(0.0, at), strict=True):
        np.testing.assert_array_equal(one, two)


def test_a_simulation_forgets_wherever_it_may_be_resumed(box_body, mat, monkeypatch):
    forget, asked = BodyMotion.forget, []
    motion = BodyMotion(box_body, sliding(frames=AT_ONCE + 2), mat)
    start = dressed(Newton(potential_of(mat)), motion)[0]
    monkeypatch.setattr(BodyMotion, "forget", lambda self: asked.append(self) or forget(self))
    simulate(potential_of(mat), motion, start)
    assert len(asked) == 2
