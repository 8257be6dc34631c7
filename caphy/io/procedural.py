"""A motion made from nothing but a seed, for where no motion capture is at hand."""

from __future__ import annotations

from collections.abc import Iterator

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

BLEND = 0.5
"""Time over which one action passes into the next [s]."""

CONTACT = 0.01
"""Height above the lowest point of the soles at which a point hardly bears weight any more [m]."""


def procedural_motion(seed: int = 0, seconds: float = 20.0, fps: float = 30.0) -> PoseSequence:
    """A motion of standing, walking, turning, arm raises, squats and jumps in an order drawn from ``seed``.

    Each six actions in a row are all different. Joint angles stay within :func:`limits`; the feet stand on y = 0 and do
    not slide: the root moves as the bearing foot demands. The same arguments give the same motion. ``seconds`` [s] and
    ``fps`` [Hz] must be positive, else :class:`CaphyError`.
    """
    if not (0 < seconds < 1e5 and 1 <= fps <= 1000):
        raise CaphyError(f"a motion needs 0 < seconds < 100000 and 1 <= fps <= 1000, got {seconds} and {fps}")
    count = max(2, round(seconds * fps) + 1)
    angles, turning, lift = _blended(count, fps, np.random.default_rng(seed))
    ranges = limits()
    free = [JOINT_NAMES.index("pelvis")]
    ranges[free] = [-np.pi, np.pi]
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
    for name in _script(rng):
        make, seconds = ACTIONS[name]
        seconds *= rng.uniform(0.9, 1.1)
        first = int(np.ceil(start * fps))
        if first >= count:
            break
        last = min(count - 1, int(np.floor((start + seconds) * fps)))
        # evaluated to its own end even where the motion ends before
        whole = np.append(np.arange(first, int(np.floor((start + seconds) * fps)) + 1) / fps - start, seconds)
        action: Action = make(whole, rng)
        weight = np.clip(whole / BLEND, 0, 1) if first else np.ones_like(whole)
        weight = np.minimum(weight, np.clip((seconds - whole) / BLEND, 0, 1))
        weight = (weight**2 * (3 - 2 * weight))[: last - first + 1]
        if last == count - 1:  # nothing follows to blend into
            tail = whole[: last - first + 1] > seconds - BLEND
            weight[tail] = 1.0
        for joint, values in action.angles.items():
            kept = np.stack(values, axis=-1)[: last - first + 1]
            angles[first : last + 1, JOINT_NAMES.index(joint)] += weight[:, None] * kept
        turning[first : last + 1] += weight * np.broadcast_to(action.turning, whole.shape)[: last - first + 1]
        lift[first : last + 1] += np.broadcast_to(action.lift, whole.shape)[: last - first + 1]
        start += seconds - BLEND
    return angles, turning, lift


def _script(rng: np.random.Generator) -> Iterator[str]:
    """Names of actions without end, all of them in each round."""
    while True:
        yield from rng.permutation(list(ACTIONS))


def _footed(sequence: PoseSequence, lift: np.ndarray, body: RestBody) -> PoseSequence:
    """The sequence carried by its feet: the points of the soles that bear weight stand still on the ground."""
    points = sole_points(sequence, body.joints, body.sole)
    lowest = points[..., 1].min(axis=1)
    bearing = np.exp(-(points[..., 1] - lowest[:, None]) / CONTACT)
    bearing /= bearing.sum(axis=1, keepdims=True)
    step = -np.einsum("tp,tpx->tx", (bearing[1:] + bearing[:-1]) / 2, np.diff(points, axis=0))[:, [0, 2]]
    step[(lift[1:] > 0) & (lift[:-1] > 0)] = 0.0
    transl = np.zeros_like(sequence.transl)
    for axis, travelled in zip((0, 2), np.cumsum(step, axis=0).T, strict=True):
        transl[1:, axis] = travelled
        transl[:, axis] = smoothed(transl[:, axis], 0.05 * sequence.fps)
    transl[:, 1] = smoothed(lift - lowest, 0.03 * sequence.fps)
    return PoseSequence(**{**vars(sequence), "transl": transl})
