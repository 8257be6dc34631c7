"""A garment of an avatar as a model: its name, version, tensors, and how a request for it is computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from caphy.conventions import JOINT_COUNT
from service import frames
from service.avatars import Avatar
from service.engine import GarmentEngine
from service.errors import Problem
from service.openinference.messages import DATATYPE, InferRequest
from service.protocol import FramesRequest

PLATFORM: Final = "onnxruntime_onnx"
OUTPUTS: Final = ("vertices", "next_state")


@dataclass(frozen=True)
class Model:
    """One garment of one avatar."""

    avatar: Avatar
    engine: GarmentEngine

    @property
    def name(self) -> str:
        """``AVATAR.GARMENT``."""
        return f"{self.avatar.id}.{self.engine.name}"

    def metadata(self) -> dict[str, Any]:
        """As the protocol describes a model; -1 is the number of frames."""
        state = [self.engine.state_size]
        inputs = {"poses": [-1, JOINT_COUNT, 3], "transl": [-1, 3], "state": state}
        outputs = {"vertices": [-1, self.engine.vertex_count, 3], "next_state": state}
        return {
            "name": self.name,
            "versions": [self.avatar.version],
            "platform": PLATFORM,
            "inputs": _described(inputs),
            "outputs": _described(outputs),
            "parameters": {"fps": self.avatar.bundle.fps},
        }

    def request(self, asked: InferRequest, tensors: Mapping[str, np.ndarray]) -> FramesRequest:
        """The frames that ``tensors`` ask for; raises Problem where they are not those of the metadata."""
        unknown = set(tensors) - {"poses", "transl", "state"}
        if unknown:
            raise Problem(422, f"inputs: must be among poses, transl, state, got {min(unknown)[:64]!r}")
        if "poses" not in tensors:
            raise Problem(422, "inputs: poses must be among them")
        poses = tensors["poses"]
        if poses.ndim != 3:
            raise Problem(422, f"poses: must have shape [frames, {JOINT_COUNT}, 3], got {list(poses.shape)}")
        still = np.broadcast_to(np.float32(0), (len(poses), 3))  # takes no memory, however many frames are claimed
        transl = tensors.get("transl", still)
        state = tensors.get("state", np.zeros(0, np.float32))
        if state.ndim != 1:
            raise Problem(422, f"state: must have shape [{self.engine.state_size}], got {list(state.shape)}")
        fps = asked.parameters.fps
        return FramesRequest(poses, transl, self.avatar.bundle.fps if fps is None else fps, state)

    def infer(self, request: FramesRequest) -> dict[str, np.ndarray]:
        """The outputs by name."""
        answered = frames.answer(request, [self.engine], self.avatar.bundle.fps)
        return {"vertices": answered.vertices[self.engine.name], "next_state": answered.states[self.engine.name]}


def find_model(avatars: Mapping[str, Avatar], name: str, version: str | None) -> Model:
    """The model of that name; raises Problem 404 where there is none, or none of that version."""
    identifier, _, garment = name.rpartition(".")
    avatar = avatars.get(identifier)
    if avatar is None or garment not in avatar.engines:
        names = [Model(a, engine).name for a in avatars.values() for engine in a.engines.values()]
        raise Problem(404, f"there is no model {name[:100]!r}; there is {', '.join(names) or 'none'}")
    if version not in (None, avatar.version):
        raise Problem(404, f"model {name} has version {avatar.version}, not {str(version)[:64]!r}")
    return Model(avatar, avatar.engines[garment])


def _described(tensors: Mapping[str, list[int]]) -> list[dict[str, Any]]:
    return [{"name": name, "datatype": DATATYPE, "shape": shape} for name, shape in tensors.items()]
