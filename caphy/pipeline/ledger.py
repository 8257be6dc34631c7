"""What is known in a run's folder of the stages that were begun and finished."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from caphy.errors import CaphyError
from caphy.io.places import write_text
from caphy.pipeline.stage import Stage

FOLDER = "stages"
SCHEME = 2
"""How keys are told: since names and places of files do not count."""


@dataclass(frozen=True)
class Entry:
    """A stage that was begun."""

    key: str
    """Fingerprint of what it was begun with."""
    finished: bool
    seconds: float = 0.0
    """What it took, from its last start."""
    failure: str | None = None
    code: str = ""
    """Digest of the code of caphy that finished it, and of the data that come with it."""
    scheme: int = 1
    parts: Mapping[str, str] = field(default_factory=dict)
    """What the key is of, by names for people; nothing where an earlier caphy began it."""


class Ledger:
    """Entries and logs in ``RUN/stages``; damaged ones count as missing."""

    def __init__(self, run: Path) -> None:
        self.folder = run / FOLDER

    def entry(self, stage: Stage) -> Entry | None:
        """What is known of a stage."""
        try:
            return Entry(**json.loads(self.record(stage).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def write(self, stage: Stage, entry: Entry) -> None:
        """Remember a stage, whole or not at all."""
        write_text(self.record(stage), json.dumps({**asdict(entry), "scheme": SCHEME}, indent=1))

    def require_known(self, stages: Sequence[Stage]) -> None:
        """Raise CaphyError where stages were begun by an earlier caphy, whose keys say nothing of their inputs now: all
        that was made would be removed."""
        old = [stage.name for stage in stages if (entry := self.entry(stage)) is not None and entry.scheme != SCHEME]
        if old:
            raise CaphyError(
                f"{self.folder.parent}: was begun by an earlier caphy, which told inputs of stages otherwise "
                f"({', '.join(old)}); go on with that one, or give another folder for the run. Nothing was changed"
            )

    def record(self, stage: Stage) -> Path:
        """The file of its entry."""
        return self.folder / f"{stage.name}.json"

    def log(self, stage: Stage) -> Path:
        """The stage's log."""
        return self.folder / f"{stage.name}.log"

    def up_to_date(self, stage: Stage) -> bool:
        """Whether it was finished with what it depends on now, and its outputs are still there."""
        entry = self.entry(stage)
        if entry is None or not entry.finished or not all(path.exists() for path in stage.outputs):
            return False
        if not stage.whole():
            return False
        return entry.key == stage.key()

    def changed(self, stage: Stage) -> list[str] | None:
        """Names of what a stage depends on that is no longer as it was, where it is known; None unless what it left,
        finished or not, is of something else than now."""
        entry = self.entry(stage)
        if entry is None or not entry.key or entry.key == stage.key():
            return None
        if not any(path.exists() for path in stage.outputs):
            return None
        now, before = stage.parts(), entry.parts
        return [name for name in {**now, **before} if now.get(name) != before.get(name)] if before else []

    def begin(self, stage: Stage) -> None:
        """Note the start; outputs of other inputs are removed, those of the same are there to go on from.

        Raises:
            CaphyError: something is in the place of an output, of which no stage of this run is known to have made it.
        """
        key, entry = stage.key(), self.entry(stage)
        unknown = not self.record(stage).exists()
        for path in stage.outputs:
            if unknown and (path.exists() or path.is_symlink()):
                raise CaphyError(
                    f"{path}: is there already and not of this run, so it is left alone; move it away, or give another "
                    "folder for the run"
                )
        if entry is None or entry.key != key:
            self.write(stage, Entry("", finished=False))  # killed meanwhile, what is left of them counts for nothing
            for path in stage.outputs:
                _remove(path)
        self.write(stage, Entry(key, finished=False, parts=stage.parts()))

    def forget(self, stage: Stage) -> None:
        """Remove what a stage wrote, if it did."""
        if self.entry(stage) is not None:
            for path in stage.outputs:
                _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
