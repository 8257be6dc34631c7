"""Requests whose poses are conditioned before they are dressed, and what their answers say of it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from caphy.conditioning import Body, Conditioner, Conditioning, Did, Frame, condition_upright
from caphy.conditioning.conditioner import CLOSE, LATEST, LONGEST
from caphy.conditioning.seen import ROUNDING
from caphy.conventions import JOINT_COUNT, JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle
from service.errors import Problem
from service.protocol import FramesRequest

HEADER: Final = "caphy-conditioning"
OFF: Final = "off"
MOST_RUNS: Final = 100
"""Runs of frames that a header tells of; those of longer answers are cut."""
MOST_SETTINGS: Final = 2000
"""Characters of settings."""


@dataclass(frozen=True, eq=False)
class Conditioned:
    """Poses (N, 55, 3) and transl (N, 3), float32 at the avatar's rate, where garments begin anew in them, and what
    was done, JSON-ready."""

    poses: np.ndarray
    transl: np.ndarray
    settle: tuple[int, ...]
    report: dict[str, Any]


def parse_settings(text: str, fps: float) -> Conditioning | None:
    """What ``?condition=`` or hello asks for at the avatar's ``fps``: ``off`` or nothing, ``on``, or settings in JSON.

    Raises Problem 422 for anything else; ``fps`` is the avatar's and is not for clients to choose.
    """
    if text in ("", OFF):
        return None
    if len(text) > MOST_SETTINGS:
        raise Problem(422, f"condition: settings may have {MOST_SETTINGS} characters, got {len(text)}")
    try:
        given = {} if text == "on" else json.loads(text)
        if isinstance(given, dict) and "fps" in given:
            raise CaphyError(f"conditioning: fps is the avatar's, {fps:g}; leave it out")
        if not isinstance(given, dict):
            raise ValueError("no table")
        return Conditioning.of({**given, "fps": fps})
    except (ValueError, RecursionError) as error:
        raise Problem(422, f"condition: must be on, off, or settings in JSON, got {text[:60]!r}") from error
    except CaphyError as error:
        raise Problem(422, str(error)) from error


def body_of(bundle: AvatarBundle) -> Body:
    """What conditioning needs of the avatar's body."""
    return Body(bundle.joints, float(bundle.body.vertices[:, 1].min()))


def require_conditionable(request: FramesRequest, settings: Conditioning | None) -> None:
    """Raise Problem where times or confidences are not for this request, or are none."""
    if settings is None:
        if request.times is not None or request.confidence is not None:
            raise Problem(422, "times and confidence are for conditioned motions; ask for it with ?condition=on")
        return
    if request.state.size:
        raise Problem(
            422, "a conditioned motion cannot be continued: the filter's memory is not in the state; use the stream"
        )
    frames, joints = request.poses.shape[:2]
    if request.times is not None and (request.times.shape != (frames,) or not np.isfinite(request.times).all()):
        raise Problem(422, f"times: must be {frames} finite numbers [s], one for each pose")
    try:
        require_seconds(request.times)
    except CaphyError as error:
        raise Problem(422, str(error)) from error
    if request.confidence is not None:
        if request.confidence.shape not in ((frames,), (frames, joints)):
            raise Problem(
                422, f"confidence: must have shape ({frames},) or ({frames}, 55), got {request.confidence.shape}"
            )
        _require_shares(request.confidence)


def require_seconds(times: np.ndarray | None) -> None:
    """Raise CaphyError where times (T,) [s] are so late that they resolve no frame: they are of another unit."""
    late = [] if times is None else times[np.abs(times) > LATEST].tolist()
    if late:
        raise CaphyError(
            f"times: must be seconds within {LATEST:g} s of 0, got {late[0]:g}; are they milliseconds? Divide by 1000"
        )


def _require_shares(confidence: np.ndarray) -> None:
    bad = np.argwhere(~((confidence >= -ROUNDING) & (confidence <= 1 + ROUNDING)))
    if len(bad):
        frame, *joint = bad[0].tolist()
        where = "".join(f", joint {j} ({JOINT_NAMES[j]})" for j in joint if j < JOINT_COUNT)
        got = confidence[tuple(bad[0])]
        raise Problem(
            422, f"confidence: must lie between 0, not seen, and 1, sure, got {got:g} at frame {frame}{where}"
        )


def frames_of(times: np.ndarray, fps: float) -> int:
    """How many frames at ``fps`` time stamps (T,) [s] make at most; those that do not rise, and silences, make none."""
    steps = np.diff(np.maximum.accumulate(times[np.abs(times) <= LATEST]))
    silences = steps > LONGEST
    return int(float(steps[~silences].sum()) * fps + CLOSE) + 1 + int(silences.sum())


def conditioned(request: FramesRequest, settings: Conditioning, body: Body) -> Conditioned:
    """The request's poses, conditioned; raises Problem where nobody is in them."""
    conditioner = Conditioner(settings, body)
    times = np.arange(len(request.poses)) / request.fps if request.times is None else request.times
    frames = condition_upright(conditioner, times, request.poses, request.transl, request.confidence)
    if not frames:
        raise Problem(422, f"nobody was seen in any of {len(times)} poses, so there is nothing to dress")
    report = {
        "settings": asdict(settings),
        "latency": settings.latency,
        "start": frames[0].time,
        **conditioner.summary.as_json(),
        "did": runs(frames),
        "world": conditioner.world(),
    }
    return Conditioned(*arrays(frames), settled_at(frames), report)


def arrays(frames: Sequence[Frame]) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 55, 3) and transl (N, 3) of frames, float32; N may be 0."""
    poses = np.array([frame.poses for frame in frames], np.float32).reshape(-1, 55, 3)
    return poses, np.array([frame.transl for frame in frames], np.float32).reshape(-1, 3)


def settled_at(frames: Sequence[Frame]) -> tuple[int, ...]:
    """Where garments begin anew."""
    return tuple(i for i, frame in enumerate(frames) if Did.RESET in frame.did)


def runs(frames: Sequence[Frame]) -> list[list[int]]:
    """[first frame, last frame, flags of :class:`Did`] of every run of frames to which the same was done, if any."""
    found: list[list[int]] = []
    for i, frame in enumerate(frames):
        did = int(frame.did)
        if found and found[-1][1] == i - 1 and found[-1][2] == did:
            found[-1][1] = i
        elif did:
            found.append([i, i, did])
    return found[:MOST_RUNS]


def header(report: Mapping[str, Any] | None) -> dict[str, str]:
    """The header that says what was done to the poses of an answer."""
    return {HEADER: OFF if report is None else json.dumps(report, separators=(",", ":"))}
