"""The state a simulation starts from: the garment draped in T-pose, then worn into the motion's first frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence
from caphy.rotations import axis_angle_from_quaternion, quaternion_from_axis_angle, slerp
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import ImplicitEuler, State
from caphy.solve.newton import Newton, Report
from caphy.solve.rollout import Simulator

SECONDS = 1.0
"""Length of the way from the T-pose into the first frame [s]."""

FASTEST = 100.0
"""Speed of a body beyond which its first two frames are no motion [m/s]."""

_FPS = 30.0
_TOLERANCE = 1e-3  # newtons: about a vertex's weight, plenty on the way to a start
_RUN_UP = 0.1  # seconds of the first frame's own motion that the preroll anticipates


def preroll_poses(poses: PoseSequence, seconds: float = SECONDS) -> PoseSequence:
    """A way from the T-pose into the first frame that arrives there at the speed of the motion.

    The root keeps the first frame's orientation and travels at its velocity (which no cloth can feel); joints follow
    the shortest rotation, eased in and out.
    """
    count = round(seconds * _FPS) + 1
    back = np.linspace(-seconds, 0, count)[:, None]  # time before the first frame
    first = quaternion_from_axis_angle(poses.poses[:1])
    target = first
    if len(poses) > 1:
        following = quaternion_from_axis_angle(poses.poses[1:2])
        lead = -_RUN_UP * (1 - np.exp(back / _RUN_UP)) * poses.fps
        target = slerp(first, following, lead)
    rest = np.zeros_like(first)
    rest[..., 0] = 1
    rest[:, 0] = first[:, 0]
    s = 1 + back / seconds
    arrived = slerp(np.broadcast_to(rest, (count, *rest.shape[1:])), target, s * s * (3 - 2 * s))
    velocity = (poses.transl[1] - poses.transl[0]) * poses.fps if len(poses) > 1 else np.zeros(3)
    if (speed := float(np.linalg.norm(velocity))) > FASTEST:
        raise CaphyError(
            f"{poses.source}: from its first frame to its second the body leaps by {speed / poses.fps:.3g} m "
            f"({speed:.0f} m/s); cut the first frame off, or give the motion in metres at its own frame rate"
        )
    transl = poses.transl[0] + back * velocity
    return replace(poses, poses=axis_angle_from_quaternion(arrived), transl=transl, fps=_FPS, unseen=None)


def start_state(newton: Newton, motion: BodyMotion, seconds: float = SECONDS) -> State:
    """The state at the motion's first frame, after dressing in T-pose and moving into that frame.

    Whether the solver converged on the way is not told: :func:`dressed` does.
    """
    return dressed(newton, motion, seconds)[0]


def dressed(
    newton: Newton, motion: BodyMotion, seconds: float = SECONDS
) -> tuple[State, tuple[tuple[Report, ...], ...]]:
    """The start of a motion, and the reports of all minimisations on the way there, one tuple for each frame.

    Integrated by implicit Euler, whose damping is welcome here.
    """
    poses = preroll_poses(motion.poses, seconds)
    start = motion.start - seconds  # time goes by the motion's own clock: a gust blows on
    way = BodyMotion(motion.body, poses, motion.garment, motion.betas, start)
    anchors = way.anchors(start + np.array([0.0, 1 / way.fps]))
    x = torch.from_numpy(anchors[0].copy())
    state = State(start, x, torch.from_numpy((anchors[1] - anchors[0]) * way.fps))
    simulator = Simulator(newton.within(max(newton.tolerance, _TOLERANCE)), way, ImplicitEuler())
    reports = []
    for _ in range(len(way) - 1):
        state, report = simulator.advance(state, 1 / way.fps)
        reports.append(report)
    return State(motion.start, state.x, state.v), tuple(reports)
