"""Runs garment networks: one thread per run, no spinning, many frames or many streams at once."""

from __future__ import annotations

from typing import Final, cast

import numpy as np
import onnxruntime

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError
from caphy.io.blend_shapes import blend_shapes
from caphy.io.bundle import BundledGarment
from caphy.io.onnx_wire import with_output
from service.normals import VertexNormals

STREAMS: Final = 16
"""Most streams of one run: enough that matrices are multiplied at full speed, and few enough for the cache."""


class GarmentEngine:
    """One garment's network, ready to run from any thread.

    Raises CaphyError where the ONNX graph is damaged, has other inputs and outputs than the bundle promises, or does
    not answer the rest pose with finite vertices.
    """

    def __init__(self, garment: BundledGarment, chunk: int = 32) -> None:
        self.name = garment.name
        self.state_size = garment.state_size
        self.vertex_count = len(garment.mesh.vertices)
        self.normals = VertexNormals(garment.mesh.faces, self.vertex_count)
        self._chunk = chunk
        self._weights = ""
        self._session = _session(garment.name, garment.onnx)
        self._joins_streams = self._require_interface()
        self._weights = blend_shapes(garment).tensor
        self._session = _session(garment.name, with_output(garment.onnx, self._weights))
        rest = np.zeros((2 * chunk, JOINT_COUNT, 3), np.float32), np.zeros((2 * chunk, 3), np.float32)
        if not np.isfinite(self.run(*rest, self.initial_state())[0]).all():  # also warms every buffer up
            raise CaphyError(f"garment {self.name!r}: the rest pose gives vertices that are not finite")
        self.weight_count = self.blend(*rest, self.initial_state())[0].shape[1]

    def initial_state(self) -> np.ndarray:
        """The state (S,) before the first frame."""
        return np.zeros(self.state_size, np.float32)

    def run(self, poses: np.ndarray, transl: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (T, V, 3) [m] of poses (T, 55, 3) [rad] and transl (T, 3) [m] after ``state``, and the state after
        them; all float32."""
        vertices = np.empty((len(poses), self.vertex_count, 3), np.float32)
        for part, inputs in self._parts(poses, transl):
            outputs = self._session.run(("vertices", "next_state"), {**inputs, "state": state})
            vertices[part], state = cast(list[np.ndarray], outputs)
        return vertices, state

    def blend(self, poses: np.ndarray, transl: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`run`, with the weights (T, R) of the garment's blend shapes in the place of its vertices."""
        found = []
        for _, inputs in self._parts(poses, transl):
            outputs = self._session.run((self._weights, "next_state"), {**inputs, "state": state})
            weights, state = cast(list[np.ndarray], outputs)
            found.append(weights)
        return np.concatenate(found), state

    def run_together(
        self, poses: np.ndarray, transl: np.ndarray, states: np.ndarray, weights: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """One frame each of B streams: vertices (B, V, 3) [m], or ``weights`` (B, R) of the garment's blend shapes, of
        poses (B, 55, 3) [rad] and transl (B, 3) [m] after ``states`` (B, S), and the states after them; all float32.

        The networks' matrices pass through the cache once for every :data:`STREAMS` streams instead of once for each.
        Graphs of exports before streams could be joined are run one after another.
        """
        outputs = (self._weights if weights else "vertices", "next_state")
        step = STREAMS if self._joins_streams else 1
        shown, after = [], []
        for start in range(0, len(poses), step):
            part = slice(start, start + step)
            inputs = {"poses": poses[part], "transl": transl[part], "state": states[part].reshape(-1)}
            found = cast(list[np.ndarray], self._session.run(outputs, inputs))
            shown.append(found[0])
            after.append(found[1].reshape(-1, self.state_size))
        return (shown[0], after[0]) if len(shown) == 1 else (np.concatenate(shown), np.concatenate(after))

    def _parts(self, poses: np.ndarray, transl: np.ndarray) -> list[tuple[slice, dict[str, np.ndarray]]]:
        parts = [slice(start, start + self._chunk) for start in range(0, len(poses), self._chunk)]
        return [(part, {"poses": poses[part], "transl": transl[part]}) for part in parts]

    def _require_interface(self) -> bool:
        """Whether the graph computes several streams at once; raises CaphyError where it is no garment's."""
        tensors = [*self._session.get_inputs(), *self._session.get_outputs()]
        found = {t.name: t.shape if t.name.endswith("state") else t.shape[1:] for t in tensors}
        joined = found.get("state") == [f"streams*{self.state_size}"]
        state = found["state"] if joined else [self.state_size]
        expected = {
            "poses": [JOINT_COUNT, 3],
            "transl": [3],
            "state": state,
            "vertices": [self.vertex_count, 3],
            "next_state": state,
        }
        if found != expected or any(t.type != "tensor(float)" for t in tensors):
            raise CaphyError(
                f"garment {self.name!r}: the ONNX graph must have float tensors {expected}, it has {found}; "
                "export the avatar again"
            )
        return joined


def _session(name: str, content: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises classes of its own, not exported
        raise CaphyError(
            f"garment {name!r}: onnxruntime cannot load its graph ({error}); export the avatar again"
        ) from error
