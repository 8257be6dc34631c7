"""What 'caphy segment' made the labels in a folder of, kept beside them: what was made otherwise is made anew."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from caphy.errors import CaphyError
from caphy.io.places import write_text
from caphy.kept import digest

if TYPE_CHECKING:
    from caphy.scan.scan import Scan

MADE = "made.json"


class MadeLabels:
    """Labels ``NAME.npy`` in a folder, those that 'caphy segment' made of something, and those of somebody else."""

    def __init__(self, folder: Path, parser: str, layout: str, learnt: np.ndarray | None = None) -> None:
        """``parser`` and ``layout`` as 'caphy segment' takes them; ``learnt`` is what the parser learnt of the set.

        Raises:
            CaphyError: they are files that cannot be read.
        """
        self.folder, self._made = folder, _read(folder / MADE)
        self._with_labels = parser == "labels"
        self._by: dict[str, Any] = {"parser": parser, "layout": None}
        if learnt is not None:
            self._by["learnt"] = digest(learnt)
        if parser not in ("labels", "colour"):
            from caphy.scan.label_layouts import find_layout

            self._by = {"parser": digest(_content(Path(parser))), "layout": digest(find_layout(layout))}

    def path(self, name: str) -> Path:
        """The file of a scan's labels."""
        return self.folder / f"{name}.npy"

    def foreign(self, name: str) -> bool:
        """Whether there are labels of a scan that were not made here, or were edited since: they are left alone."""
        from caphy.scan.scan_set import read_labels

        if not self.path(name).is_file():
            return False
        try:
            return self._made.get(name, {}).get("labels") != digest(read_labels(self.path(name)))
        except CaphyError:  # of a kind that is not written here
            return True

    def up_to_date(self, scan: Scan) -> bool:
        """Whether its labels were made of it as it is, by this parser."""
        made = {key: value for key, value in self._made.get(scan.name, {}).items() if key != "labels"}
        return self.path(scan.name).is_file() and made == self._of(scan)

    def write(self, scan: Scan, labels: np.ndarray) -> None:
        """Write labels (V,) of a scan and what they are of; a kill in between leaves none, and they are made again."""
        from caphy.scan.scan_set import write_labels

        labels = np.asarray(labels, dtype=np.uint8)
        self.remove(scan.name)
        self._made[scan.name] = {**self._of(scan), "labels": digest(labels)}
        write_text(self.folder / MADE, json.dumps(self._made, indent=1, sort_keys=True))
        write_labels(self.path(scan.name), labels)

    def remove(self, name: str) -> None:
        """Remove a scan's labels."""
        self.path(name).unlink(missing_ok=True)

    def _of(self, scan: Scan) -> dict[str, Any]:
        content = replace(scan, source="", labels=scan.labels if self._with_labels else None)
        return {**self._by, "scan": digest(content)}


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise CaphyError(f"{path}: cannot be read ({error.strerror}); give a human parser as ONNX") from error


def _read(path: Path) -> dict[str, dict[str, Any]]:
    """What was kept; nothing where it is damaged, so that labels count as somebody else's."""
    try:
        made = json.loads(path.read_text(encoding="utf-8"))
        return {name: dict(one) for name, one in made.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}
