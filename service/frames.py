"""One request for frames: what it may hold, and how it is answered."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from caphy.conventions import JOINT_COUNT, JOINT_NAMES
from caphy.io.poses import PoseSequence
from caphy.io.poses.sequence import MAX_ANGLE, MAX_DISTANCE
from caphy.rotations import quaternion_from_axis_angle
from service.clients.given import RATES
from service.conditioned import Conditioned, frames_of
from service.encodings import LABELS, Encoding, JointMotion, Meshes
from service.engine import GarmentEngine
from service.errors import Problem
from service.json_bodies import validated
from service.protocol import FramesRequest, FramesResponse
from service.settings import Settings
from service.settling import run_settling
from service.states import require_states, split_states

SKELETONS: Final = {
    21: "SMPL-X's body joints without the root",
    22: "SMPL-X's body without hands and face",
    23: "SMPL's body joints without the root",
    24: "SMPL, whose joints 22 and 23 are hands",
    52: "SMPL-H, which has no jaw and eyes",
    54: "SMPL-X without the root",
}
"""What a wrong number of joints probably is."""
Numbers = Annotated[list[float], Field(fail_fast=True)]
Rows = Annotated[list[Numbers], Field(fail_fast=True)]


class JsonRequest(BaseModel):
    """Body of a request in JSON."""

    # strict: true is not one frame a second, and "0.5" is not an angle; whole numbers still are
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)

    poses: Annotated[list[Rows], Field(fail_fast=True)] = Field(
        description="axis-angle per frame and SMPL-X joint [rad]: (T, 55, 3)"
    )
    transl: Rows | None = Field(None, description="translation per frame [m]: (T, 3), y up; zero if absent")
    fps: float = Field(description="frames per second of the poses [Hz]")
    state: dict[str, Numbers] = Field({}, description="state per garment, from the answer this one continues")
    times: Numbers | None = Field(None, description="time stamp per frame [s]: (T,), for conditioned motions")
    confidence: Rows | Numbers | None = Field(
        None, description="per frame, or frame and joint, 0 for not seen to 1: (T,) or (T, 55), for conditioned motions"
    )


def parse_json(body: bytes, engines: list[GarmentEngine], most: int) -> FramesRequest:
    """The request in a JSON body, of at most ``most`` frames; raises Problem where it is not one."""
    parsed = validated(JsonRequest, body, most, sum(engine.state_size for engine in engines))
    poses = _array(parsed.poses, "poses", "(frames, 55, 3)", 3)
    transl = np.zeros((len(poses), 3)) if parsed.transl is None else _array(parsed.transl, "transl", "(frames, 3)", 2)
    times = None if parsed.times is None else _array(parsed.times, "times", "(frames,)", 1)
    confidence = parsed.confidence
    if confidence is not None:
        deep = bool(confidence) and isinstance(confidence[0], list)
        confidence = _array(confidence, "confidence", "(frames,) or (frames, 55)", 2 if deep else 1)
    return FramesRequest(poses, transl, parsed.fps, _joined_state(parsed.state, engines), times, confidence)


def _array(values: list[Any], name: str, shape: str, dimensions: int) -> np.ndarray:
    try:
        array = np.array(values, np.float64)
    except ValueError as error:
        raise Problem(422, f"{name}: every frame must hold as many numbers: {shape}") from error
    if array.ndim != dimensions:
        raise Problem(422, f"{name}: must have shape {shape}, got {array.shape}")
    return array


def _joined_state(states: Mapping[str, list[float]], engines: list[GarmentEngine]) -> np.ndarray:
    if not states:
        return np.zeros(0)
    expected = {engine.name: engine.state_size for engine in engines}
    found = {name: len(state) for name, state in states.items()}
    if found != expected:
        raise Problem(422, f"state: must hold {expected} floats by garment, got {found}")
    return np.concatenate([states[engine.name] for engine in engines])


def require_valid(request: FramesRequest, settings: Settings, fps: float, engines: Sequence[GarmentEngine]) -> None:
    """Raise Problem unless ``engines`` at ``fps`` can answer the request."""
    frames, joints = request.poses.shape[:2]
    if joints != JOINT_COUNT or request.poses.shape[2] != 3:
        guess = f" (that is {SKELETONS[joints]})" if joints in SKELETONS else ""
        raise Problem(
            422,
            f"poses: must have {JOINT_COUNT} joints of 3 numbers, those of SMPL-X in its order, got "
            f"{joints} of {request.poses.shape[2]}{guess}; convert the file with 'caphy poses convert'",
        )
    if request.transl.shape != (frames, 3):
        raise Problem(422, f"transl: must have shape ({frames}, 3), got {request.transl.shape}")
    if not RATES[0] <= request.fps <= RATES[1]:
        raise Problem(422, f"fps: must lie between {RATES[0]:g} and {RATES[1]:g}, got {request.fps:g}")
    if frames == 0:
        raise Problem(422, "poses: there must be at least one frame")
    answered = answered_frames(request, fps)
    if max(frames, answered) > settings.max_frames:
        first = (
            ""
            if request.fps == fps or request.times is not None
            else f"resample it to {fps:g} fps, and if that is still too long "
        )
        given = f"at {request.fps:g} fps" if request.times is None else "with times"
        raise Problem(
            413,
            f"at most {settings.max_frames} frames are sent or answered at once, got {frames} {given}, "
            f"which are {answered} at {fps:g} fps; {first}send the motion in parts and "
            "pass each answer's state on, or, where it is conditioned, use the stream",
        )
    require_states(request.state, engines)
    if request.state.size and request.fps != fps:
        raise Problem(
            422, f"a motion is continued at {fps:g} fps only, got {request.fps:g}; resample the whole of it first"
        )
    require_bounded(request)


def same_rate(told: float, own: float) -> float:
    """A rate that came in single precision [Hz], or the avatar's own where that is what was meant."""
    return own if np.float32(told) == np.float32(own) else told


def answered_frames(request: FramesRequest, fps: float) -> int:
    """How many frames at ``fps`` answer the request, at most where it is conditioned."""
    frames = len(request.poses)
    if request.times is not None:
        return frames_of(request.times, fps)
    return frames if request.fps == fps else int((frames - 1) / request.fps * fps + 1e-6) + 1


def require_bounded(request: FramesRequest) -> None:
    """Raise Problem naming frame and joint where an angle or a translation is not finite or absurd."""
    with np.errstate(all="ignore"):  # signalling NaN, infinity
        if _is_small(request.poses, MAX_ANGLE / 2) and _is_small(request.transl, MAX_DISTANCE):
            return  # nearly always: then nothing need be looked at one by one
        angle = np.linalg.norm(request.poses, axis=-1)
    bad = np.argwhere(~(angle <= MAX_ANGLE))
    if len(bad):
        frame, joint = bad[0]
        raise Problem(
            422,
            f"poses: angles must be finite and at most {MAX_ANGLE:.1f} rad, got {angle[frame, joint]:g} "
            f"at frame {frame}, joint {joint} ({JOINT_NAMES[joint]}); are they degrees?",
        )
    bad = np.argwhere(~(np.abs(request.transl) <= MAX_DISTANCE))
    if len(bad):
        frame, axis = bad[0]
        raise Problem(
            422,
            f"transl: must be finite and within {MAX_DISTANCE:g} m of the origin, got "
            f"{request.transl[frame, axis]:g} at frame {frame}; are they millimetres?",
        )


def _is_small(array: np.ndarray, most: float) -> bool:
    """Whether every number lies within ``most`` of zero; NaN does not."""
    return bool(array.min(initial=0) >= -most and array.max(initial=0) <= most)


@dataclass(frozen=True)
class Wanted:
    """What an answer shall hold: vertices or blend weights, packed how, and normals or not."""

    encoding: Encoding = Encoding.FLOAT32
    normals: bool = False

    @classmethod
    def of(cls, encoding: str, normals: bool) -> Wanted:
        """What a query or a hello asks for; raises Problem where it cannot be had."""
        if encoding not in LABELS:
            raise Problem(422, f"encoding: must be one of {', '.join(LABELS)}, got {encoding[:40]!r}")
        if normals and encoding == Encoding.WEIGHTS.label:
            raise Problem(422, "normals: are not sent with weights; the avatar's GLB holds their morph targets")
        return cls(Encoding(LABELS.index(encoding)), normals)


def answer(
    request: FramesRequest,
    engines: list[GarmentEngine],
    fps: float,
    wanted: Wanted = Wanted(),
    pelvis: np.ndarray | None = None,
    conditions: Conditioned | None = None,
) -> FramesResponse:
    """Run ``engines`` on a valid request, resampled to their ``fps``; for weights the rest ``pelvis`` (3,) [m] too.

    conditions: its poses after conditioning, which takes the place of resampling.
    """
    poses, transl = request.poses, request.transl
    if conditions is not None:
        poses, transl = conditions.poses, conditions.transl
    elif request.fps != fps:
        resampled = PoseSequence(poses=poses, transl=transl, fps=request.fps, source="request").resample(fps)
        poses, transl = resampled.poses, resampled.transl
    poses, transl = (np.ascontiguousarray(array, np.float32) for array in (poses, transl))
    settle, report = ((), None) if conditions is None else (conditions.settle, conditions.report)
    meshes, states = dress(engines, poses, transl, split_states(engines, request.state), wanted, pelvis, settle)
    fields = meshes.normals, meshes.weights, meshes.joints
    return FramesResponse(meshes.vertices, states, fps, request.fps, wanted.encoding, *fields, report)


def dress(
    engines: list[GarmentEngine],
    poses: np.ndarray,
    transl: np.ndarray,
    states: Mapping[str, np.ndarray],
    wanted: Wanted,
    pelvis: np.ndarray | None = None,
    settle: Sequence[int] = (),
) -> tuple[Meshes, dict[str, np.ndarray]]:
    """Meshes of poses (T, 55, 3) and transl (T, 3), float32 at the engines' rate, and the states after them; the
    garments begin anew at the frames ``settle``."""
    shown, after = {}, {}
    for engine in engines:
        weights, state = wanted.encoding is Encoding.WEIGHTS, states[engine.name]
        shown[engine.name], after[engine.name] = run_settling(engine, weights, poses, transl, state, settle)
        require_finite(engine.name, shown[engine.name], after[engine.name])
    return packed(engines, poses, transl, shown, wanted, pelvis), after


def packed(
    engines: list[GarmentEngine],
    poses: np.ndarray,
    transl: np.ndarray,
    shown: Mapping[str, np.ndarray],
    wanted: Wanted,
    pelvis: np.ndarray | None,
) -> Meshes:
    """What engines showed, vertices or blend weights, with all that the encoding adds."""
    if wanted.encoding is Encoding.WEIGHTS:
        if pelvis is None:
            raise ValueError("weights need the rest pelvis")
        turns = quaternion_from_axis_angle(poses.astype(np.float64))
        turns = turns / np.linalg.norm(turns, axis=-1, keepdims=True)
        joints = JointMotion(pelvis + transl, turns[..., [1, 2, 3, 0]])
        return Meshes(len(poses), weights=shown, joints=joints)
    normals = {engine.name: engine.normals(shown[engine.name]) for engine in engines} if wanted.normals else {}
    return Meshes(len(poses), shown, normals)


def require_finite(name: str, *arrays: np.ndarray) -> None:
    """Raise Problem where a network was driven out of the numbers."""
    if not all(np.isfinite(array).all() for array in arrays):
        raise Problem(422, f"garment {name!r} left the finite numbers; is the state one it answered itself?")


def json_answer(response: FramesResponse) -> bytes:
    """The JSON of a response; positions to a hundredth of a millimetre.

    Frame by frame, because the encoder holds the interpreter's lock while it works and other requests wait.
    """
    frames = len(next(iter(response.vertices.values())))
    head = {"fps": response.fps, "request_fps": response.request_fps, "frames": frames}
    if response.conditioning is not None:
        head["conditioning"] = response.conditioning
    garments = []
    for name, vertices in response.vertices.items():
        encoded = ",".join(json.dumps(np.round(frame.astype(np.float64), 5).tolist()) for frame in vertices)
        state = json.dumps(response.states[name].astype(np.float64).tolist())
        garments.append(f'{json.dumps(name)}:{{"vertices":[{encoded}],"state":{state}}}')
    return f'{json.dumps(head)[:-1]},"garments":{{{",".join(garments)}}}}}'.encode()
