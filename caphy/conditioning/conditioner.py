"""Poses in as they come, frames out at the model's rate: calm, complete, a fixed time later."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from caphy.conditioning.blending import Offsets, eased
from caphy.conditioning.body import Body, bundled_body, standing_height
from caphy.conditioning.frame import Did, Frame, Summary
from caphy.conditioning.gate import is_path_strange, is_pose_strange, names, strange_joints
from caphy.conditioning.ground import Ground
from caphy.conditioning.likelihood import MOST, unlikeliness
from caphy.conditioning.quaternions import between, exponential, heading, logarithm, product, rotated
from caphy.conditioning.reach import within_reach
from caphy.conditioning.seen import camera_rotation, checked
from caphy.conditioning.settings import Conditioning
from caphy.conditioning.standing import standing_pose
from caphy.conditioning.track import NEVER, PathTrack, RotationTrack
from caphy.conditioning.world import LEVEL, Upright, turned_root
from caphy.conventions import BODY_JOINT_COUNT, JOINT_COUNT

SURE: Final = 1 / 30
"""Precision of a fully trusted sample [s]: 30 of them make a second."""
CLOSE: Final = 1e-6
LEAST_STEP: Final = 0.0005
"""Time stamps that differ by less are the same [s]."""
LATEST: Final = 1e11
"""Beyond it time stamps no longer resolve a frame [s]."""
CUT_DISTANCE: Final = 0.75
"""A root that is found so far from where it was held is put there at once [m] ..."""
CUT_TURN: Final = np.radians(75.0)
"""... and so is one turned so far [rad]."""
TURN_SPEED: Final = 6.0
"""At which a joint that is found again approaches where it is [rad/s]."""
WALK_SPEED: Final = 2.0
"""At which the root does [m/s]."""
SOON: Final = 0.1
"""A joint that was seen so long ago and is strange now has jumped [s]."""
BRIDGE: Final = 0.25
"""Over longer gaps nothing is interpolated: what was before tells nothing of what comes after [s]."""
LONGEST: Final = 10.0
"""A longer step of the time stamps is a silence, which is left out [s]: nobody waits for frames of a body at rest."""
RELATIVE: Final = np.arange(JOINT_COUNT) > 0


class Conditioner:
    """Turns poses with time stamps into :class:`Frame` at ``settings.fps``, never looking ahead further than stated.

    Every call of :meth:`push` returns the frames that it completes: the frame of a moment is complete as soon as time
    has gone on by ``settings.latency``. The same poses give the same frames, however they are cut into calls.
    """

    def __init__(
        self, settings: Conditioning | None = None, body: Body | None = None, longest: float = LONGEST
    ) -> None:
        """``body``: the avatar's, the bundled one where none is given. ``longest``: a step of the time stamps beyond
        it is left out [s]."""
        self.settings = settings or Conditioning()
        self.summary = Summary()
        self.body = body or bundled_body()
        self._longest = longest
        self._standing = standing_pose()
        self._start()

    def push(
        self,
        time: float,
        poses: np.ndarray | None,
        transl: np.ndarray | None = None,
        confidence: np.ndarray | float | None = None,
        camera: np.ndarray | None = None,
    ) -> list[Frame]:
        """Take what was seen at ``time`` [s] and return the frames that are complete now.

        poses: (55, 3) axis-angle [rad], or none where nobody was seen. transl: (3,) [m], or none where it is not
        known. confidence: of each joint (55,) or of all, from 0, not seen, to 1; 1 where not given. camera: rotation
        (3, 3) from the camera's axes to the world's, y up, where it is known. Values that are not finite, and times
        that do not rise, are refused and said so in the next frame's notes. Raises :class:`CaphyError` for arrays of
        another shape.
        """
        poses, transl, trust = checked(poses, transl, confidence)
        self.summary.received += 1
        if not abs(time) <= LATEST or time < self._time + LEAST_STEP:
            self._refuse(f"its time stamp {time:g} s does not come after {self._time:g} s", "time stamp")
            return []
        frames = self._skip(float(time))
        self._time = float(time)
        if poses is None or not trust.any():
            self._refuse("nobody was seen", "nobody", Did.NOTHING)
        else:
            frames += self._take(exponential(poses), transl, trust, None if camera is None else camera_rotation(camera))
        return frames + self._frames(self._time - self.settings.latency)

    def flush(self) -> list[Frame]:
        """The frames up to the last pose, which need not wait: nothing comes after it."""
        return self._frames(self._time)

    def restart(self) -> None:
        """What comes next is a new motion, on a new clock."""
        self._start()

    def _start(self) -> None:
        cutoff = 2 * np.pi * self.settings.cutoff
        self._turns = RotationTrack(self._standing, cutoff**-4, SURE, self.settings.latency)
        self._path = PathTrack(np.zeros((1, 3)), cutoff**-4, SURE, self.settings.latency)
        self._time = NEVER
        self._first: float | None = None
        self._count = 0
        self._out: tuple[np.ndarray, np.ndarray] | None = None
        self._was_held = np.zeros(JOINT_COUNT, bool)
        self._rested = self._was_unplaced = False
        self._before = NEVER
        self._turn_offsets = Offsets(JOINT_COUNT, TURN_SPEED)
        self._path_offsets = Offsets(1, WALK_SPEED)
        self._did, self._notes = Did.NOTHING, []
        self._upright = Upright(self.body)
        if self.settings.up is not None:
            self._upright.tell(np.array(self.settings.up))
        self._ground = Ground(self.body, self.settings)
        self._jumped = False

    def know_world(self, other: Conditioner) -> None:
        """Begin with what another knows of up in the camera's axes, which looked at the same motion."""
        self._upright.begin_with(other._upright)

    def world(self) -> dict[str, Any]:
        """Where up, floor and scale were found so far, JSON-ready, with the uncertainty of up."""
        upright = self._upright.as_json() if self.settings.frame == "camera" else {}
        return {**upright, **self._ground.as_json()}

    def _skip(self, time: float) -> list[Frame]:
        """Let the frames' clock begin anew after a step of the poses' clock that is too long; returns the frames before
        it, which need not wait."""
        if self._first is None or time - self._time <= self._longest:
            return []
        frames = self.flush()
        self._first, self._count = time, 0
        self._was_held[:] = True
        self._rested = self._was_unplaced = True
        self._notes.append(f"time went on by {time - self._time:.1f} s at once; frames between are left out")
        return frames

    def _refuse(self, why: str, kind: str, did: Did = Did.REJECTED) -> None:
        self.summary.refused[kind] += 1
        self._did |= did
        self._notes.append(f"not used: {why}")

    def _take(
        self, turns: np.ndarray, transl: np.ndarray | None, trust: np.ndarray, camera: np.ndarray | None
    ) -> list[Frame]:
        """Take a pose in; returns the frames of a long gap that it ends."""
        turns, beyond = self._within_reach(turns)
        if (far := unlikeliness(logarithm(turns), trust)) > MOST:
            self._refuse(f"it is no posture of a body (squared distance {far:.0f}, at most {MOST:.0f})", "posture")
            return []
        if (beyond & (trust > 0)).any():
            self._did |= Did.LIMITED
            self._notes.append(f"turned too far: {names(beyond & (trust > 0))}")
        level = np.concatenate([product(LEVEL, turns[0])[None], turns[1:]])
        if self.settings.frame == "camera":
            turns, transl = self._in_world(turns, transl, camera)
        jumped = np.zeros(JOINT_COUNT, bool)
        if self._first is None:
            self._first = self._time
        else:
            strange, jumped = self._doubted(turns, trust)
            if is_pose_strange(strange):
                self._refuse(f"it jumps: {names(strange)}", "jump")
                return []
            if strange.any():
                self._refuse(f"these joints jump: {names(strange)}", "joints")
            trust = np.where(strange, 0.0, trust)
        frames = self._gap_frames(trust)
        self._turns.forget(jumped)  # believed only because it lasts: the past would bend the curve
        self._turns.add(self._time, turns, trust)
        if self.settings.frame == "camera" and trust[0]:
            self._upright.look(level, SURE)
        if trust[0] and transl is not None:
            self._take_path(transl, trust[:1], bool(jumped[0] or frames))
        return frames

    def _gap_frames(self, trust: np.ndarray) -> list[Frame]:
        """Where a body is found after a long gap: the frames of the gap, which cannot know of it any more."""
        if not trust[0] or self._time - self._turns.last[0] < BRIDGE or self._turns.last[0] == NEVER:
            return []
        frames = self._frames(self._time - 2 * CLOSE)
        self._turns.forget(np.ones(JOINT_COUNT, bool))
        return frames

    def _within_reach(self, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        vectors, beyond = within_reach(logarithm(turns))
        return (exponential(vectors), beyond) if beyond.any() else (turns, beyond)

    def _in_world(
        self, turns: np.ndarray, transl: np.ndarray | None, camera: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        rotation = self._upright.rotation() if camera is None else camera
        place = np.zeros(3) if transl is None else transl
        root, place = turned_root(rotation, turns[0], place, self.body.joints[0])
        return np.concatenate([root[None], turns[1:]]), None if transl is None else place

    def _doubted(self, turns: np.ndarray, trust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which joints (55,) must not be believed, and which are only because they were not seen for some time."""
        last = self._turns.last
        since = np.where(last == NEVER, np.inf, self._time - last)
        expected = self._turns.at(self._time)
        strange = strange_joints(expected, turns, since) & (trust > 0)
        at_once = strange_joints(expected, turns, np.minimum(since, SOON)) & (trust > 0)
        return strange, at_once & ~strange

    def _take_path(self, transl: np.ndarray, trust: np.ndarray, anew: bool) -> None:
        last = float(self._path.last[0])
        if last != NEVER:
            expected = self._path.at(self._time)[0]
            if not anew and is_path_strange(expected, transl, self._time - last):
                return self._refuse("its translation jumps", "translation")
            if anew or is_path_strange(expected, transl, min(self._time - last, SOON)):
                self._path.forget(np.ones(1, bool))
        self._path.add(self._time, transl[None], trust)
        return None

    def _frames(self, until: float) -> list[Frame]:
        if self._first is None:
            return []
        frames = []
        while (time := self._first + self._count / self.settings.fps) <= until + CLOSE:
            frames.append(self._frame(time))
            self.summary.add(frames[-1])
            self._count += 1
        return frames

    def _frame(self, time: float) -> Frame:
        turns, place = self._turns.at(time), self._path.at(time)
        self._turns.follow(turns)
        away = np.maximum(time - self._turns.last, 0)  # never seen: infinite
        held = away > CLOSE
        share = eased((away - self.settings.hold) / self.settings.relax)
        turns, place = self._relaxed(turns, place, share)
        turns, place = self._approached(time, turns, place)
        self._was_held, self._out, self._rested = held, (turns, place), bool(share[0] == 1)
        self._was_unplaced, self._before = self._is_unplaced(time), time
        self._mention(held, bool(share[0] > 0))
        stands = self._ground.put(turns, place[0], self._jumped)
        frame = Frame(time, logarithm(turns), stands, self._did, tuple(self._notes))
        self._did, self._notes, self._jumped = Did.NOTHING, [], False
        return frame

    def _mention(self, held: np.ndarray, resting: bool) -> None:
        if held[:BODY_JOINT_COUNT].all():
            self._did |= Did.RESTING if resting else Did.HELD
        elif held[:BODY_JOINT_COUNT].any():
            self._did |= Did.PART_HELD

    def _relaxed(self, turns: np.ndarray, place: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is not seen for long goes over, by its share (55,), into standing upright, facing where it faced; the
        soles stay as high as they were."""
        if not share.any():
            return turns, place
        goal = self._standing.copy()
        goal[0] = heading(turns[0])
        relaxed = rotated(turns, share[:, None] * between(turns, goal))
        if not share[0]:
            return relaxed, place
        rise = standing_height(self.body.soles(turns)) - standing_height(self.body.soles(relaxed))
        return relaxed, place + np.array([0.0, rise, 0.0])

    def _approached(self, time: float, turns: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From where the body was held to where it is found, without a jump; or at once where that is too far."""
        if self._out is None:
            self._did |= Did.RESET
            return turns, place
        found = self._was_held & (self._turns.last > self._before)  # also if it is lost again by now
        placed = self._was_unplaced and bool(self._path.last[0] > self._before)
        if found.any() or placed:
            self._begin_approach(time, found, placed, between(turns, self._out[0]), self._out[1] - place)
        return rotated(turns, self._turn_offsets.at(time)), place + self._path_offsets.at(time)

    def _is_unplaced(self, time: float) -> bool:
        """Whether the root's place is held at this moment."""
        return bool(time - self._path.last[0] > CLOSE)

    def _begin_approach(
        self, time: float, found: np.ndarray, placed: bool, turned: np.ndarray, moved: np.ndarray
    ) -> None:
        far = (found[0] and np.linalg.norm(turned[0]) > CUT_TURN) or (placed and np.linalg.norm(moved) > CUT_DISTANCE)
        if far or (found[0] and self._rested):
            self._did |= Did.RESET
            self._notes.append("found again after long, or far away: the garment begins anew")
        if far:
            self._jumped = True
            self._path_offsets.clear()
            self._turn_offsets.begin(found, RELATIVE[:, None] * turned, time)
            return
        self._turn_offsets.begin(found, turned, time)
        if placed:
            self._path_offsets.begin(np.ones(1, bool), moved, time)
