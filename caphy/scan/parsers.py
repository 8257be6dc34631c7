"""Human parsers: from a picture of a person to a label for every pixel."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from caphy.errors import CaphyError
from caphy.scan.label_layouts import LabelLayout
from caphy.scan.scan import LABEL_NAMES, UNKNOWN
from caphy.scan.views import ScanView

LABEL_COUNT: Final = len(LABEL_NAMES)


class Parser(Protocol):
    """Tells what each pixel of a view shows."""

    def parse(self, view: ScanView) -> np.ndarray:
        """Labels (H, W) uint8 of a view's pixels; :data:`UNKNOWN` where the parser has nothing to say."""
        ...


class OnnxParser:
    """A published parser as an ONNX graph: image (1, 3, H, W) in, scores (1, classes, h, w) out."""

    def __init__(self, path: Path, layout: LabelLayout) -> None:
        import onnxruntime

        self.path, self.layout = path, layout
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        if not path.is_file():
            raise CaphyError(f"{path}: there is no such file; give a human parser exported to ONNX")
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # the runtime has no common exception
            raise CaphyError(f"{path}: onnxruntime cannot load this graph: {error}") from error
        self._input = self._session.get_inputs()[0]

    def parse(self, view: ScanView) -> np.ndarray:
        """Labels (H, W) of a view; the picture is padded to the graph's shape, so that nobody is stretched."""
        import cv2

        height, width = self._size()
        image, (top, left, used_height, used_width) = _letterboxed(view.colour, height, width)
        colour = (image.astype(np.float32) / 255 - np.array(self.layout.mean, np.float32)) / np.array(
            self.layout.std, np.float32
        )
        if self.layout.order == "bgr":
            colour = colour[..., ::-1]
        scores = self._scores(np.ascontiguousarray(colour.transpose(2, 0, 1)[None]))
        rows, columns = view.face.shape
        full = cv2.resize(scores.transpose(1, 2, 0), (width, height), interpolation=cv2.INTER_LINEAR)
        full = full[top : top + used_height, left : left + used_width]
        best = cv2.resize(full, (columns, rows), interpolation=cv2.INTER_LINEAR).argmax(axis=2)
        table = np.array([UNKNOWN if label < 0 else label for label in self.layout.label_of_class], dtype=np.uint8)
        return np.where(view.hit, table[best], UNKNOWN).astype(np.uint8)

    def _size(self) -> tuple[int, int]:
        """Height and width of the input: the graph's own where it fixes them, else the layout's."""
        shape = self._input.shape
        fixed = len(shape) == 4 and all(isinstance(n, int) and n > 0 for n in shape[2:])
        return (shape[2], shape[3]) if fixed else self.layout.size

    def _scores(self, image: np.ndarray) -> np.ndarray:
        """Scores (classes, h, w) of the first output that has as many channels as the layout has classes."""
        try:
            outputs: Any = self._session.run(None, {self._input.name: image})
        except Exception as error:
            raise CaphyError(f"{self.path}: does not take an image of shape {image.shape}: {error}") from error
        count = len(self.layout.classes)
        for output in outputs:
            if output.ndim == 4 and output.shape[1] == count:
                return output[0].astype(np.float32)
        shapes = ", ".join(str(output.shape) for output in outputs)
        raise CaphyError(
            f"{self.path}: must give scores (1, {count}, h, w) for the {count} classes of this layout, got {shapes}; "
            "name another --layout"
        )


def _letterboxed(image: np.ndarray, height: int, width: int) -> tuple[np.ndarray, tuple[int, int, int, int]]:
    """The image scaled into (height, width) with its backdrop around; and top, left, height and width of its place."""
    import cv2

    rows, columns = image.shape[:2]
    scale = min(height / rows, width / columns)
    inner = max(round(rows * scale), 1), max(round(columns * scale), 1)
    top, left = (height - inner[0]) // 2, (width - inner[1]) // 2
    canvas = np.full((height, width, 3), 255, dtype=np.uint8)
    canvas[top : top + inner[0], left : left + inner[1]] = cv2.resize(
        image, inner[::-1], interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    )
    return canvas, (top, left, *inner)
