"""What a detector of body landmarks says about a picture, and mediapipe's as one."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.errors import CaphyError

LANDMARKS: Final = (
    *("nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer"),
    *("left_ear", "right_ear", "left_mouth", "right_mouth"),
    *(f"{s}_{part}" for part in ("shoulder", "elbow", "wrist", "pinky", "index", "thumb") for s in ("left", "right")),
    *(f"{s}_{part}" for part in ("hip", "knee", "ankle", "heel", "foot_index") for s in ("left", "right")),
)
"""The 33 landmarks of BlazePose in its order (Bazarevsky et al., CVPR workshops 2020)."""


_SURE: Final = 0.7
"""Score above which a detection counts as a person: a face of its own."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """One person in one picture.

    pixels: (33, 2) column and row, may lie outside of the picture.
    world: (33, 3) [m] about the middle of the hips: right, down, away, as seen along the ray through the person.
    visibility: (33,) 0 to 1.
    """

    pixels: np.ndarray
    world: np.ndarray
    visibility: np.ndarray


Detector = Callable[[np.ndarray], Landmarks | None]
"""From a picture (H, W, 3) uint8 RGB to the person in it, or none."""


class MediapipeDetector:
    """BlazePose in mediapipe: detects once, then follows the same person from picture to picture.

    Its own smoothing is off: what filters, and how late that makes the poses, is decided in one place, the service's
    conditioning.

    Raises CaphyError where mediapipe is not installed.
    """

    def __init__(self) -> None:
        self._pose = _mediapipe().solutions.pose.Pose(model_complexity=1, smooth_landmarks=False)

    def __call__(self, picture: np.ndarray) -> Landmarks | None:
        """The most prominent person, or none."""
        found = self._pose.process(picture)
        if not found.pose_landmarks or not found.pose_world_landmarks:
            return None
        height, width = picture.shape[:2]
        seen = found.pose_landmarks.landmark
        pixels = np.array([(point.x * width, point.y * height) for point in seen])
        world = np.array([(point.x, point.y, point.z) for point in found.pose_world_landmarks.landmark])
        return Landmarks(pixels, world, np.array([point.visibility for point in seen]))

    def close(self) -> None:
        """Free the models."""
        self._pose.close()


class PeopleCounter:
    """How many people a picture shows, by the detector that mediapipe begins with; 13 ms a picture."""

    _GRAPH = """
        input_stream: "picture"
        output_stream: "people"
        node { calculator: "PoseDetectionCpu" input_stream: "IMAGE:picture" output_stream: "DETECTIONS:people" }
    """

    def __init__(self) -> None:
        self._mediapipe = _mediapipe()
        bindings = importlib.import_module("mediapipe.python._framework_bindings.resource_util")
        bindings.set_resource_dir(str(Path(self._mediapipe.__file__).parents[1]))
        self._graph = self._mediapipe.CalculatorGraph(graph_config=self._GRAPH)
        self._graph.observe_output_stream("people", self._note)
        self._graph.start_run()
        self._asked = self._found = 0

    def __call__(self, picture: np.ndarray) -> int:
        """People in a picture (H, W, 3) uint8 RGB."""
        self._asked, self._found = self._asked + 1, 0
        image = self._mediapipe.packet_creator.create_image_frame(
            image_format=self._mediapipe.ImageFormat.SRGB, data=np.ascontiguousarray(picture)
        )
        self._graph.add_packet_to_input_stream("picture", image.at(self._asked))
        self._graph.wait_until_idle()
        return self._found

    def _note(self, _: str, packet: Any) -> None:
        people = self._mediapipe.packet_getter.get_proto_list(packet)
        self._found = sum(person.score[0] > _SURE for person in people)

    def close(self) -> None:
        """Free the model."""
        self._graph.close()


def _mediapipe() -> Any:
    try:
        return importlib.import_module("mediapipe")
    except ImportError as error:
        raise CaphyError(
            f"the monocular client needs mediapipe ({error}); it has an environment of its own, because mediapipe "
            "wants numpy 1: python3 -m venv .venv/monocular && "
            ".venv/monocular/bin/pip install -r service/clients/monocular/requirements.txt"
        ) from None
