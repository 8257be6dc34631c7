"""Whether the body of a measurement can be the one that wore the cloth: its place, axes, size, and order of poses."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.conventions import BODY_JOINT_COUNT, JOINT_NAMES
from caphy.io.measurements.measurement import Measurement
from caphy.io.poses.sequence import Y_UP_FROM_Z_UP, PoseSequence

REACH: Final = 0.45
"""Distance [m] within which the median point of clothing has a joint of the body, or a vertex of its mesh ..."""
ASTRAY: Final = 1.5
"""... and so many times that within which it has one in each single frame."""
TURNED: Final = 60.0
"""Degrees by which clothing is not turned against its rest shape carried along by the poses, in half of the frames."""
FEWEST: Final = 10
"""Vertices that must be seen for that."""
UPRIGHT: Final = 0.8
"""Part of the way from pelvis to neck that lies along z, in half of the frames, from which z seems to be up."""
JITTERS: Final = 0.03
"""Mean step [m] of joints beside the pelvis, to the next frame, from which the order of poses can be judged."""
TURNS: Final = 0.9
"""That step over the one to the frame after, from which on poses are in no order."""
JUMP: Final = 3.0
"""Times the motion's longest step that the step from its preroll to it is not."""
OPEN: Final = 0.02
"""Share of a body's edges that may belong to one face only: a mouth, wrists without hands."""
TALLEST: Final = 5.0
"""Diagonal [m] that a body does not reach."""
APART: Final = 0.25
"""Distance [m] within which most joints of the poses have a vertex of the body's mesh."""

_NECK: Final = JOINT_NAMES.index("neck")


def require_body(measurement: Measurement, axes_stated: bool) -> None:
    """Raise :class:`CaphyError`, saying what to change, unless the body, if there is one, can have worn the cloth."""
    _require_mesh(measurement)
    if measurement.poses is None or measurement.transl is None:
        return
    PoseSequence(measurement.poses, measurement.transl, measurement.fps, source=measurement.source)  # no degrees
    measurement = measurement.about(_bundled_pelvis())
    joints = _joints(measurement)
    if not axes_stated:
        _require_upright(measurement, joints)
    _require_near(measurement, joints)
    _require_order(measurement, joints)
    _require_preroll(measurement, joints)
    _require_worn(measurement)
    _require_one_body(measurement, joints)


def _bundled_pelvis() -> np.ndarray:
    from caphy.body.bundled import default_body

    return default_body().joints[0]


def _joints(measurement: Measurement) -> np.ndarray:
    from caphy.body.bundled import default_body

    assert measurement.poses is not None
    return default_body().posed_joints(measurement.poses, measurement.transl, measurement.betas)


def _some(measurement: Measurement, most: int) -> np.ndarray:
    """Seen frames, evenly spread, the last among them."""
    frames = measurement.seen_frames
    return frames[np.unique(np.linspace(0, len(frames) - 1, most).astype(int))]


def _require_upright(measurement: Measurement, joints: np.ndarray) -> None:
    spine = joints[:, _NECK] - joints[:, 0]
    spine /= np.linalg.norm(spine, axis=1, keepdims=True)
    up, away = np.median(spine[:, 1]), np.median(np.abs(spine[:, 2]))
    if away > UPRIGHT and up < 0.5:
        raise measurement.error(
            "the body stands along z, so z seems to be up; state up_axis = 'z' in the file (or up_axis = 'y' if it "
            "does lie that way)"
        )


def _require_near(measurement: Measurement, joints: np.ndarray) -> None:
    """Clothing lies near its body's joints, in the same world, at the same time."""
    frames = _some(measurement, 200)
    each = _distances(measurement, joints, frames, np.eye(3))
    away = float(np.median(each))
    if away > REACH:
        for rotation, advice in (
            (Y_UP_FROM_Z_UP, "the cloth has z up and the poses y up; turn it, or state up_axis = 'z' if both have"),
            (Y_UP_FROM_Z_UP.T, "the poses have z up and the cloth y up; turn them"),
        ):
            if np.median(_distances(measurement, joints, frames, rotation)) < min(REACH, 0.5 * away):
                raise measurement.error(f"the cloth lies {away:.2f} m from the joints of its body: {advice}")
        raise measurement.error(
            f"the cloth lies {away:.2f} m from the joints of its body; vertices, poses and transl must be in one world "
            "frame, in metres, with transl added after turning about the pelvis as in SMPL-X"
        )
    _require_each_near(measurement, frames, each, "the joints of its body; are both of the same moments?")


def _require_each_near(measurement: Measurement, frames: np.ndarray, each: np.ndarray, what: str) -> None:
    if each.max() > ASTRAY * REACH:
        worst, many = int(frames[each.argmax()]), int((each > ASTRAY * REACH).sum())
        raise measurement.error(
            f"in frame {measurement.number(worst)} the cloth lies {each.max():.2f} m from {what} ({many} of "
            f"{len(frames)} frames tried)"
        )


def _distances(measurement: Measurement, joints: np.ndarray, frames: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Median distance (n,) [m] of the cloth, turned, from the nearest joint in each frame."""
    found = []
    for frame in frames:
        cloud = measurement.cloud(int(frame))
        cloud = cloud[:: max(len(cloud) // 200, 1)] @ rotation.T
        found.append(np.median(np.linalg.norm(cloud[:, None] - joints[frame], axis=-1).min(axis=1)))
    return np.array(found)


def _require_order(measurement: Measurement, joints: np.ndarray) -> None:
    """Poses in the order of time: joints change less to the next frame than to the one after."""
    limbs = joints[:, :BODY_JOINT_COUNT] - joints[:, :1]
    if len(limbs) < 6:
        return
    one, two = (float(np.median(np.linalg.norm(limbs[lag:] - limbs[:-lag], axis=2).mean(1))) for lag in (1, 2))
    if one > JITTERS and one > TURNS * two:
        raise measurement.error(
            f"the poses look shuffled: joints move {one / two:.2g} times as far to the next frame as to the one after; "
            "sort them by time"
        )


def _require_preroll(measurement: Measurement, joints: np.ndarray) -> None:
    """The preroll ends one frame before the motion begins."""
    if measurement.preroll_poses is None or measurement.preroll_transl is None or len(measurement.preroll_poses) == 0:
        return
    from caphy.body.bundled import default_body

    before = default_body().posed_joints(measurement.preroll_poses, measurement.preroll_transl, measurement.betas)
    limbs = np.concatenate([before, joints])[:, :BODY_JOINT_COUNT]
    steps = np.linalg.norm(np.diff(limbs, axis=0), axis=2).max(axis=1)
    own = float(steps[len(before) :].max(initial=0.0))
    jump = float(steps[len(before) - 1])
    if jump > max(JUMP * own, REACH):
        raise measurement.error(
            f"a joint moves {jump:.2f} m from the last frame of the preroll to the first of the motion, and within it "
            f"{own:.2f} m at most; preroll_poses and preroll_transl must end one frame before the motion, in its world"
        )


def _require_worn(measurement: Measurement) -> None:
    """Rest shapes are clothing on the body's T-pose: carried along by the poses they lie as the cloth does."""
    if measurement.rest_vertices is None or measurement.vertices is None:
        return
    assert measurement.poses is not None
    assert measurement.transl is not None
    from scipy.spatial.transform import Rotation

    from caphy.body.bundled import default_body
    from caphy.body.skinning import blend_transforms, skin

    body, rest, frames = default_body(), measurement.rest_vertices, _some(measurement, 20)
    weights = measurement.weights
    if weights is None:  # a file of the garment's has them
        joints = body.rest(measurement.betas)[1][:BODY_JOINT_COUNT]
        weights = np.eye(len(JOINT_NAMES))[np.linalg.norm(rest[:, None] - joints, axis=-1).argmin(axis=1)]
    blended = blend_transforms(weights, body.transforms(measurement.poses[frames], measurement.betas))
    carried = skin(blended, rest) + measurement.transl[frames, None]
    turn, away = [], []
    for frame, expected in zip(frames, carried, strict=True):
        seen = measurement.observed[frame]
        if seen.sum() < FEWEST:
            continue
        a, b = expected[seen], measurement.vertices[frame, seen]
        turned = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))[0]
        turn.append(np.degrees(turned.magnitude()))
        away.append(np.median(np.linalg.norm(a - b, axis=1)))
    if not turn:
        return
    if np.median(turn) > TURNED:
        raise measurement.error(
            f"the cloth is turned by {np.median(turn):.0f} degrees against its rest shape on the posed body; give "
            "rest_vertices on the body's T-pose, y up, and poses [rad] and vertices with the same axis up"
        )
    if np.median(away) > REACH:
        raise measurement.error(
            f"the cloth lies {np.median(away):.2f} m from where poses and transl carry rest_vertices; give "
            "rest_vertices on the body's T-pose, with the body's origin, not in a posed frame"
        )


def _require_mesh(measurement: Measurement) -> None:
    """A body's mesh is of a body's size, closed, and near clothing that nothing else holds."""
    if measurement.body_vertices is None or measurement.body_faces is None:
        return
    frames = _some(measurement, 20)
    size = float(np.median(np.linalg.norm(np.ptp(measurement.body_vertices[frames], axis=1), axis=1)))
    if size > TALLEST:
        raise measurement.error(
            f"body_vertices must be in metres, but the body measures {size:.3g} across; multiply millimetres by 0.001, "
            "centimetres by 0.01"
        )
    faces = measurement.body_faces
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    alone = int((np.unique(pairs, axis=0, return_counts=True)[1] == 1).sum())
    if alone > OPEN * len(pairs) / 2:
        raise measurement.error(
            f"the body must be a closed mesh, {alone} of its edges belong to one face only; fill its holes, or give "
            "poses instead"
        )
    a, b, c = (measurement.body_vertices[frames[0]] - measurement.body_vertices[frames[0]].mean(0))[faces.T]
    if (np.cross(a, b) * c).sum() < 0:
        raise measurement.error(
            "body_faces must be counter-clockwise seen from outside, they are inside out; flip them"
        )
    if measurement.pinned is not None:
        return
    from scipy.spatial import KDTree

    each = []
    for frame in frames:
        cloud = measurement.cloud(int(frame))
        tree = KDTree(measurement.body_vertices[frame])
        each.append(np.median(tree.query(cloud[:: max(len(cloud) // 200, 1)])[0]))
    away = float(np.median(each))
    if away > REACH:
        raise measurement.error(
            f"the cloth lies {away:.2f} m from its body; vertices and body_vertices must be in one world frame, in "
            "metres, with the same axis up"
        )
    _require_each_near(measurement, frames, np.array(each), "its body; are both of the same moments?")


def _require_one_body(measurement: Measurement, joints: np.ndarray) -> None:
    """Poses beside a body's mesh are its poses, as far as most joints show."""
    if measurement.body_vertices is None:
        return
    from scipy.spatial import KDTree

    frames = _some(measurement, 20)
    away = [
        np.median(KDTree(measurement.body_vertices[frame]).query(joints[frame, :BODY_JOINT_COUNT])[0])
        for frame in frames
    ]
    if np.median(away) > APART:
        raise measurement.error(
            f"half of the joints that the poses give lie {np.median(away):.2f} m or more from body_vertices; both must "
            "be of one body, in one world frame"
        )
