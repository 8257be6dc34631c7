"""A motion made from nothing but a seed, for where no motion capture is at hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.poses.ground import smoothed, sole_points
from caphy.io.poses.sequence import PoseSequence
from caphy.io.poses.skeleton import axis_rotations
from caphy.io.procedural_actions import ACTIONS, Action
from caphy.io.procedural_limits import limits
from caphy.io.retarget import RestBody
from caphy.io.retarget_rest import rest_of
from caphy.rotations import axis_angle_from_matrix

BLEND: Final = 0.5
"""Time over which one action passes into the next [s]."""

CONTACT: Final = 0.01
"""Height above the lowest point of the soles at which a point hardly bears weight any more [m]."""


GLIDE: Final = 0.15
"""Width of the Gaussian that evens the root's horizontal speed within a step [s], as a body's inertia does."""


LANDING: Final = 0.03
"""Width of the Gaussian that softens take-off and landing [s]."""


def procedural_motion(seed: int = 0, seconds: float = 20.0, fps: float = 30.0) -> PoseSequence:
    """A motion of standing, walking, turning, arm raises, squats and jumps in an order drawn from ``seed``.

    Each round of six actions holds them all. Joint angles stay within :func:`limits`; the feet stand on y = 0 and
    hardly slide, as the root moves as the bearing foot demands. The same arguments give the same motion. ``seconds``
    [s] and ``fps`` [Hz] must be positive, else :class:`CaphyError`.
    """
    if not (0 < seconds < 1e5 and 1 <= fps <= 1000):
        raise CaphyError(f"a motion needs 0 < seconds < 100000 and 1 <= fps <= 1000, got {seconds} and {fps}")
    count = max(2, round(seconds * fps) + 1)
    angles, turning, lift = _blended(count, fps, np.random.default_rng(seed))
    ranges = limits()
    ranges[0] = [-np.pi, np.pi]  # the pelvis is held by nothing
    angles = np.clip(np.radians(angles), ranges[..., 0], ranges[..., 1])
    rotations = (
        axis_rotations(0, angles[..., 0]) @ axis_rotations(1, angles[..., 1]) @ axis_rotations(2, angles[..., 2])
    )
    heading = np.concatenate([[0.0], np.cumsum(turning[:-1])]) / fps
    rotations[:, 0] = axis_rotations(1, heading) @ rotations[:, 0]
    body = rest_of(default_body())
    sequence = PoseSequence(
        poses=axis_angle_from_matrix(rotations),
        transl=np.zeros((count, 3)),
        fps=fps,
        source=f"procedural motion, seed {seed}",
        pelvis=body.joints[0],
        notes=("made by formula, not captured",),
    )
    return _footed(sequence, lift, body)


def _blended(count: int, fps: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles (T, 55, 3) [degrees], turning (T,) [rad/s] and lift (T,) [m] of actions passing into one another."""
    angles, turning, lift = np.zeros((count, len(JOINT_NAMES), 3)), np.zeros(count), np.zeros(count)
    start = 0.0
    for make, seconds in _script(rng):
        frames = np.arange(int(np.ceil(start * fps)), int(np.floor((start + seconds) * fps)) + 1)
        if frames[0] >= count:
            break
        time = np.append(frames / fps - start, seconds)  # to its end, even where the motion ends before
        action = make(time, rng)
        weight = _eased((seconds - time) / BLEND) * (_eased(time / BLEND) if start else 1.0)
        kept = frames[frames < count]
        for joint, values in action.angles.items():
            angles[kept, JOINT_NAMES.index(joint)] += (weight * np.stack(values)).T[: len(kept)]
        turning[kept] += (weight * action.turning)[: len(kept)]
        lift[kept] += (weight * action.lift)[: len(kept)]
        start += seconds - BLEND
    return angles, turning, lift


def _eased(share: np.ndarray) -> np.ndarray:
    share = np.clip(share, 0, 1)
    return share**2 * (3 - 2 * share)


def _script(rng: np.random.Generator) -> Iterator[tuple[Callable[..., Action], float]]:
    """Actions and their durations [s] without end, all of them in each round."""
    while True:
        for name in rng.permutation(list(ACTIONS)):
            make, seconds = ACTIONS[name]
            yield make, seconds * rng.uniform(0.9, 1.1)


def _footed(sequence: PoseSequence, lift: np.ndarray, body: RestBody) -> PoseSequence:
    """The sequence carried by its feet: the points of the soles that bear weight stand still on the ground."""
    points = sole_points(sequence, body.joints, body.sole)
    lowest = points[..., 1].min(axis=1)
    bearing = np.exp(-(points[..., 1] - lowest[:, None]) / CONTACT)
    bearing /= bearing.sum(axis=1, keepdims=True)
    step = -np.einsum("tp,tpx->tx", (bearing[1:] + bearing[:-1]) / 2, np.diff(points, axis=0))[:, [0, 2]]
    step[(lift[1:] > 0) & (lift[:-1] > 0)] = 0.0
    x, z = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)]).T
    wide, narrow = GLIDE * sequence.fps, LANDING * sequence.fps
    transl = np.stack([smoothed(x, wide), smoothed(lift - lowest, narrow), smoothed(z, wide)], axis=-1)
    return replace(sequence, transl=transl)
