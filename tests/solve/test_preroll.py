"""Whether a start converged is known, and said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from test_body_motion import potential_of, sliding

from caphy.commands.simulate import _dressed
from caphy.kept import Kept
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton
from caphy.solve.preroll import dressed, start_state


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
    first = _dressed(potential_of(mat), motion, Kept(tmp_path))
    said = capsys.readouterr().out
    assert "30 of 30 frames on the way to the start did not converge; largest force left 2.5e-01 N" in said
    monkeypatch.setattr(Newton, "minimise", minimise)
    np.testing.assert_array_equal(_dressed(potential_of(mat), motion, Kept(tmp_path)).x, first.x)
    assert capsys.readouterr().out == said
