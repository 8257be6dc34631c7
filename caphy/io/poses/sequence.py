"""A motion as SMPL-X joint rotations over time, checked when it is made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from caphy.conventions import JOINT_COUNT, JOINT_NAMES
from caphy.errors import CaphyError
from caphy.rotations import (
    axis_angle_from_matrix,
    axis_angle_from_quaternion,
    matrix_from_axis_angle,
    quaternion_from_axis_angle,
    slerp,
)

SMPLX_PELVIS: Final = (0.0031233, -0.3514075, 0.0120366)
"""Rest position of the pelvis joint of the neutral SMPL-X body at zero betas [m]."""

SMPL_PELVIS: Final = {
    "neutral": (-0.0017951, -0.2233338, 0.0282192),
    "male": (-0.0021737, -0.2407892, 0.0285838),
    "female": (-0.0008763, -0.2114187, 0.0278211),
}
"""Rest position of the pelvis joint of SMPL and SMPL-H at zero betas [m]."""

Y_UP_FROM_Z_UP: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns (x, y, z) with z up into (x, z, -y) with y up: a quarter turn about x, no mirroring."""

MAX_ANGULAR_SPEED: Final = 60.0
"""Joint speed above which a step counts as a jump [rad/s]; a kicking knee reaches about 30 (Nunome et al. 2002)."""

MAX_LINEAR_SPEED: Final = 12.0
"""Root speed above which a step counts as a jump [m/s]: a sprinter's."""


MAX_ANGLE: Final = 4 * np.pi
"""Largest rotation of a joint [rad]: more than two turns are degrees, or a mistake."""

MAX_DISTANCE: Final = 1000.0
"""Largest translation along an axis [m]: beyond it float32 no longer resolves a tenth of a millimetre."""

RATES: Final = (0.1, 10_000.0)
"""Frame rates that motions have [Hz]; what lies below is the time of a frame."""


@dataclass(frozen=True)
class Jump:
    """A step between two frames too fast for a body."""

    frame: int
    joint: str
    speed: float
    unit: Literal["rad/s", "m/s"]

    def __str__(self) -> str:
        return f"frame {self.frame}: {self.joint} moves at {self.speed:.0f} {self.unit}"


@dataclass(frozen=True, eq=False)
class PoseSequence:
    """T frames of a motion, as SMPL-X takes them.

    The root turns about the rest position of the pelvis joint, so the pelvis stands at ``pelvis + transl``
    (Pavlakos et al., CVPR 2019). Raises :class:`CaphyError` naming source, frame and joint for wrong shapes,
    values that are not finite, or beyond :data:`MAX_ANGLE`, :data:`MAX_DISTANCE` or :data:`RATES`: degrees,
    millimetres or the time of a frame, which resampling would turn into another motion.

    poses: (T, 55, 3) axis-angle of every joint relative to its parent [rad].
    transl: (T, 3) translation added after posing [m].
    fps: frames per second [Hz].
    up_axis, frame: the world's up axis; "camera" where the world is only a camera's view.
    source: the file or generator it came from.
    betas: (B,) shape coefficients of ``model``, or none.
    model: the body whose rotations these are: "smplx", "smplh" or "smpl".
    pelvis: (3,) rest position of the pelvis joint that ``transl`` refers to [m].
    notes: what the reader had to assume, in plain words.
    unseen: (T,) of the frames in which nobody was seen and which a reader filled in, or none where all were seen.
    """

    poses: np.ndarray
    transl: np.ndarray
    fps: float
    up_axis: Literal["y", "z"] = "y"
    frame: Literal["world", "camera"] = "world"
    source: str = ""
    betas: np.ndarray | None = None
    model: str = "smplx"
    pelvis: np.ndarray | tuple[float, float, float] = SMPLX_PELVIS
    notes: tuple[str, ...] = ()
    unseen: np.ndarray | None = None

    def __post_init__(self) -> None:
        where = self.source or "pose sequence"
        poses = _array(self.poses, where, "poses")
        if poses.ndim != 3 or poses.shape[1:] != (JOINT_COUNT, 3) or len(poses) == 0:
            raise CaphyError(
                f"{where}: poses must have shape (frames, {JOINT_COUNT}, 3) with at least one frame, got {poses.shape}"
            )
        transl = _array(self.transl, where, "transl")
        if transl.shape != (len(poses), 3):
            raise CaphyError(f"{where}: transl must have shape ({len(poses)}, 3), got {transl.shape}")
        _require_bounded(poses, transl, where)
        try:
            fps = float(self.fps)
        except (TypeError, ValueError) as error:
            raise CaphyError(f"{where}: fps must be a number, got {self.fps!r}") from error
        require_rate(fps, where)
        for name, value, choices in (
            ("up_axis", self.up_axis, ("y", "z")),
            ("frame", self.frame, ("world", "camera")),
        ):
            if value not in choices:
                raise CaphyError(f"{where}: {name} must be one of {choices}, got {value!r}")
        pelvis = _array(self.pelvis, where, "pelvis")
        if pelvis.shape != (3,) or not np.isfinite(pelvis).all():
            raise CaphyError(f"{where}: pelvis must be three finite numbers, got {self.pelvis!r}")
        betas = None if self.betas is None else _array(self.betas, where, "betas").ravel()
        if betas is not None and not np.isfinite(betas).all():
            raise CaphyError(f"{where}: betas must be finite, got {betas}")
        unseen = None if self.unseen is None else np.array(self.unseen, dtype=bool)
        if unseen is not None and unseen.shape != (len(poses),):
            raise CaphyError(f"{where}: unseen must tell of each of {len(poses)} frames, got shape {unseen.shape}")
        for name, value in (
            ("unseen", unseen),
            ("poses", poses),
            ("transl", transl),
            ("pelvis", pelvis),
            ("betas", betas),
            ("fps", fps),
            ("notes", tuple(self.notes)),
        ):
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, frames: slice) -> PoseSequence:
        """The frames of a slice; a step keeps the motion's speed, so it divides the frame rate."""
        if not isinstance(frames, slice):
            raise TypeError("index a PoseSequence with a slice; single frames are sequence.poses[i]")
        if (frames.step or 1) < 1:
            raise CaphyError(f"{self.source}: a slice must go forward in time, got step {frames.step}")
        return replace(
            self,
            poses=self.poses[frames],
            transl=self.transl[frames],
            fps=self.fps / (frames.step or 1),
            unseen=None if self.unseen is None else self.unseen[frames],
        )

    @property
    def duration(self) -> float:
        """Time from the first to the last frame [s]."""
        return (len(self) - 1) / self.fps

    def with_notes(self, *notes: str) -> PoseSequence:
        """The same motion with further remarks."""
        return replace(self, notes=(*self.notes, *notes))

    def resample(self, fps: float) -> PoseSequence:
        """The motion at another frame rate: rotations by slerp, translation linear; never past the last frame."""
        require_rate(fps, self.source, "resample to another rate, as with 'caphy poses convert --resample RATE'")
        if fps == self.fps or len(self) == 1:
            return replace(self, fps=fps)
        count = int(np.floor(self.duration * fps + 1e-6)) + 1
        time = np.minimum(np.arange(count) * (self.fps / fps), len(self) - 1)
        poses, transl = interpolate(self.poses, self.transl, np.arange(len(self)), time)
        unseen = None if self.unseen is None else self.unseen[np.floor(time + 0.5).astype(int)]
        return replace(self, poses=poses, transl=transl, fps=fps, unseen=unseen)

    def about(self, pelvis: np.ndarray) -> PoseSequence:
        """The same motion as told for a body whose pelvis rests at ``pelvis`` (3,) [m], root for root."""
        return replace(self, transl=self.transl + self.pelvis - pelvis, pelvis=np.asarray(pelvis, dtype=np.float64))

    def turned(self, rotation: np.ndarray) -> PoseSequence:
        """The motion seen after a turn ``rotation`` (3, 3) of the world about its origin.

        Posed vertices turn with it: the root's rotation is multiplied from the left and, because the root turns
        about the pelvis joint j and not about the origin, t' = R (t + j) - j. ``up_axis`` is left to the caller.
        """
        poses = self.poses.copy()
        poses[:, 0] = axis_angle_from_matrix(rotation @ matrix_from_axis_angle(poses[:, 0]))
        return replace(self, poses=poses, transl=(self.transl + self.pelvis) @ rotation.T - self.pelvis)

    def to_y_up(self, pelvis: np.ndarray | None = None) -> PoseSequence:
        """The motion with y up. ``pelvis`` (3,) [m] replaces the assumed rest pelvis where the body is known."""
        sequence = self if pelvis is None else replace(self, pelvis=np.asarray(pelvis, dtype=np.float64))
        if self.up_axis == "y":
            return sequence
        return replace(sequence.turned(Y_UP_FROM_Z_UP), up_axis="y")

    def to_z_up(self, pelvis: np.ndarray | None = None) -> PoseSequence:
        """The motion with z up; the inverse of :meth:`to_y_up`."""
        sequence = self if pelvis is None else replace(self, pelvis=np.asarray(pelvis, dtype=np.float64))
        if self.up_axis == "z":
            return sequence
        return replace(sequence.turned(Y_UP_FROM_Z_UP.T), up_axis="z")

    def angular_speed(self) -> np.ndarray:
        """Speed of every joint's rotation between frames (T - 1, 55) [rad/s]."""
        q = quaternion_from_axis_angle(self.poses)
        chord = np.minimum(np.linalg.norm(q[1:] - q[:-1], axis=-1), np.linalg.norm(q[1:] + q[:-1], axis=-1))
        return 4 * np.arcsin(np.clip(chord / 2, 0, 1)) * self.fps

    def linear_speed(self) -> np.ndarray:
        """Speed of the root between frames (T - 1,) [m/s]."""
        return np.linalg.norm(np.diff(self.transl, axis=0), axis=-1) * self.fps

    def jumps(self, max_angular: float = MAX_ANGULAR_SPEED, max_linear: float = MAX_LINEAR_SPEED) -> list[Jump]:
        """Steps faster than a body moves, in order of time; ``frame`` is the one jumped to."""
        angular, linear = self.angular_speed(), self.linear_speed()
        found = [
            Jump(int(t) + 1, JOINT_NAMES[j], float(angular[t, j]), "rad/s")
            for t, j in np.argwhere(angular > max_angular)
        ]
        found += [Jump(int(t) + 1, "root", float(linear[t]), "m/s") for (t,) in np.argwhere(linear > max_linear)]
        return sorted(found, key=lambda jump: jump.frame)

    def require_world(self) -> PoseSequence:
        """The same; raises :class:`CaphyError` where these poses are in a camera's frame."""
        if self.frame == "camera":
            raise CaphyError(
                f"{self.source}: these poses are in a camera's frame, so nobody knows which way cloth falls; convert "
                "them to world coordinates first ('caphy poses condition'), or leave the file out"
            )
        return self

    def require_continuous(self) -> PoseSequence:
        """This motion; raises :class:`CaphyError` naming the first jumps if there are any."""
        found = self.jumps()
        if found:
            listed = "; ".join(map(str, found[:3]))
            raise CaphyError(
                f"{self.source}: {len(found)} steps are too fast for a body ({listed}). "
                "Check the frame rate, or cut the motion there"
            )
        return self


def interpolate(
    poses: np.ndarray, transl: np.ndarray, known: np.ndarray, wanted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations by slerp and translations linear, from ``known`` times (T,) to ``wanted`` ones (N,) within them.

    poses (T, 55, 3) and transl (T, 3) with T of at least 2 and rising times give (N, 55, 3) and (N, 3).
    """
    first = np.clip(np.searchsorted(known, wanted, side="right") - 1, 0, len(known) - 2)
    fraction = (wanted - known[first]) / (known[first + 1] - known[first])
    quaternions = quaternion_from_axis_angle(poses)
    mixed = slerp(quaternions[first], quaternions[first + 1], fraction[:, None])
    moved = transl[first] + fraction[:, None] * (transl[first + 1] - transl[first])
    return axis_angle_from_quaternion(mixed), moved


def concatenate(sequences: list[PoseSequence]) -> PoseSequence:
    """Several motions one after another; they must agree in frame rate, axes, frame, model and pelvis."""
    if not sequences:
        raise CaphyError("concatenate needs at least one pose sequence, got none")
    first = sequences[0]
    for other in sequences[1:]:
        for name in ("fps", "up_axis", "frame", "model"):
            if getattr(other, name) != getattr(first, name):
                raise CaphyError(
                    f"cannot join {first.source!r} and {other.source!r}: {name} is "
                    f"{getattr(first, name)!r} and {getattr(other, name)!r}; convert one of them first"
                )
        if not np.allclose(other.pelvis, first.pelvis):
            raise CaphyError(f"cannot join {first.source!r} and {other.source!r}: they are for different bodies")
    unseen = [np.zeros(len(s), bool) if s.unseen is None else s.unseen for s in sequences]
    return replace(
        first,
        unseen=np.concatenate(unseen) if np.any([each.any() for each in unseen]) else None,
        poses=np.concatenate([s.poses for s in sequences]),
        transl=np.concatenate([s.transl for s in sequences]),
        source=" + ".join(dict.fromkeys(s.source for s in sequences)),
        notes=tuple(dict.fromkeys(note for s in sequences for note in s.notes)),
    )


def require_rate(fps: float, where: str, way: str = "give the true rate with 'caphy poses convert --fps RATE'") -> None:
    """Raise :class:`CaphyError`, which tells the ``way`` out, where ``fps`` [Hz] is no motion's frame rate."""
    if not RATES[0] <= fps <= RATES[1]:
        hint = f"; is it the time of a frame, of {1 / fps:g} frames per second?" if 0 < fps < RATES[0] else ""
        raise CaphyError(
            f"{where}: fps must lie between {RATES[0]:g} and {RATES[1]:g} frames per second, got {fps:g}"
            + (hint or f"; {way}")
        )


def _array(values: object, where: str, name: str) -> np.ndarray:
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CaphyError(f"{where}: {name} must be numbers of one shape: {error}") from error


def _require_bounded(poses: np.ndarray, transl: np.ndarray, where: str) -> None:
    bad = np.argwhere(~np.isfinite(poses))
    if len(bad):
        frame, joint, axis = bad[0]
        raise CaphyError(
            f"{where}: poses must be finite, got {poses[frame, joint, axis]} at frame {frame}, joint "
            f"{joint} ({JOINT_NAMES[joint]}); {len(np.unique(bad[:, 0]))} of {len(poses)} frames are affected"
        )
    bad = np.argwhere(~np.isfinite(transl))
    if len(bad):
        frame, axis = bad[0]
        raise CaphyError(f"{where}: transl must be finite, got {transl[frame, axis]} at frame {frame}")
    angle = np.linalg.norm(poses, axis=-1)
    bad = np.argwhere(angle > MAX_ANGLE)
    if len(bad):
        frame, joint = bad[0]
        raise CaphyError(
            f"{where}: poses must be angles of at most {MAX_ANGLE:.1f} rad, got {angle[frame, joint]:g} at frame "
            f"{frame}, joint {joint} ({JOINT_NAMES[joint]}); are they degrees?"
        )
    bad = np.argwhere(np.abs(transl) > MAX_DISTANCE)
    if len(bad):
        frame, axis = bad[0]
        raise CaphyError(
            f"{where}: transl must be within {MAX_DISTANCE:g} m of the origin, got {transl[frame, axis]:g} at frame "
            f"{frame}; are they millimetres?"
        )
