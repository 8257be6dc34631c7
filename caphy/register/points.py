"""The segmented points of each scan with the body's pose in it, and which scans are held out; npz without pickles."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError
from caphy.garment.template import read_npz, write_npz
from caphy.io.places import write_text
from caphy.register.articulation import Placement
from caphy.register.cloud import Cloud
from caphy.register.fit import BodyFit, Progress, quiet
from caphy.scan.scan import LABEL_NAMES
from caphy.scan.scan_set import ScanSet

FORMAT = "caphy-scan-points-1"
FOLDER = "points"
SPLIT = "split.json"
HELD_OUT = 0.2
"""Share of the scans that nothing is trained on (CaPhy, section 4)."""

Part = Literal["train", "held_out"]


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """What one scan shows, part by part, and where the body stands in it.

    body, upper, lower: points (N, 3) float32 [m], world axes, y up; bare skin (with hair and shoes), upper and lower
    garment; a part may be empty. pose (55, 3) [rad] and transl (3,) [m] are the fitted body's.
    """

    name: str
    body: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    pose: np.ndarray
    transl: np.ndarray

    @classmethod
    def of(cls, cloud: Cloud, placement: Placement) -> ScanPoints:
        """The points of a labelled cloud on a body placed in it."""
        parts = {name: cloud.points[cloud.labels == i].astype(np.float32) for i, name in enumerate(LABEL_NAMES)}
        return cls(cloud.name, pose=placement.pose, transl=placement.transl, **parts)

    def save(self, folder: Path) -> None:
        """Write ``NAME.npz`` into a folder, whole or not at all."""
        arrays = {key: value for key, value in vars(self).items() if key != "name"}
        write_npz(folder / f"{self.name}.npz", {"format": np.array(FORMAT), **arrays})

    @classmethod
    def load(cls, path: Path) -> ScanPoints:
        """Read what :meth:`save` wrote.

        Raises:
            CaphyError: the file is missing, damaged or something else, or holds what is not finite.
        """
        arrays = read_npz(path)
        if str(arrays.pop("format", None)) != FORMAT:
            raise CaphyError(f"{path}: must hold a scan's points ({FORMAT!r}); 'caphy register points' writes them")
        for name, ending in (*((n, (3,)) for n in LABEL_NAMES), ("pose", (JOINT_COUNT, 3)), ("transl", (3,))):
            array = arrays.get(name)
            fits = array is not None and array.shape[-len(ending) :] == ending
            if array is None or not fits or array.ndim != (2 if name != "transl" else 1):
                raise CaphyError(
                    f"{path}: {name} is missing or of the wrong shape; make it with 'caphy register points'"
                )
            if not np.isfinite(array).all():
                raise CaphyError(f"{path}: {name} must be finite, got NaN or infinity; make it again")
        return cls(path.stem, **{name: arrays[name] for name in (*LABEL_NAMES, "pose", "transl")})


def write_points(fit: BodyFit, scans: ScanSet, run: Path, seed: int = 0, progress: Progress = quiet) -> dict[str, str]:
    """Write ``points/NAME.npz`` of every fitted scan and ``split.json`` into a run's folder.

    A split that is there already is kept for the scans that it names, if it names all: held-out scans stay held out,
    and a split made by other means (by motion, say) is respected.

    Returns:
        The scans that could not be read, name -> why; the rest is written.

    Raises:
        CaphyError: none could be.
    """
    failures, written = {}, []
    for number, (name, placement) in enumerate(zip(fit.names, fit.placements, strict=True)):
        progress("points", number, len(fit.names))
        try:
            if name not in scans.names:
                raise CaphyError(f"{scans.folder}: has no scan {name!r}, which the body fit has; give the same scans")
            ScanPoints.of(Cloud.of(scans[scans.names.index(name)]), placement).save(run / FOLDER)
            written.append(name)
        except CaphyError as error:
            failures[name] = str(error)
    if not written:
        raise CaphyError("none of the scans can be used:\n" + "\n".join(failures.values()))
    there = read_split(run) if (run / SPLIT).is_file() else None
    kept = (there and _of_these(there, written)) or split(written, seed)
    if kept != there:
        write_text(run / SPLIT, json.dumps(kept, indent=1))
    return failures


def split(names: Sequence[str], seed: int = 0) -> dict[Part, list[str]]:
    """Names drawn into 80 % ``train`` and 20 % ``held_out``; of a single scan nothing is held out."""
    count = 0 if len(names) < 2 else max(1, round(HELD_OUT * len(names)))
    held = set(np.random.default_rng(seed).permutation(len(names))[:count].tolist())
    return {
        "train": [name for i, name in enumerate(names) if i not in held],
        "held_out": [name for i, name in enumerate(names) if i in held],
    }


def read_split(run: Path) -> dict[Part, list[str]]:
    """The split of a run.

    Raises:
        CaphyError: ``split.json`` is missing or damaged, has nothing to train on, or a scan is on both sides.
    """
    path = run / SPLIT
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        train, held_out = (list(map(str, given[part])) for part in ("train", "held_out"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CaphyError(
            f"{path}: must name scans to train on and held out ({error!r}); 'caphy register points' writes it"
        ) from error
    both = sorted(set(train) & set(held_out))
    if both or not train:
        wrong = f"{both[0]} is both trained on and held out" if both else "it names nothing to train on"
        raise CaphyError(f"{path}: {wrong}; correct it, or remove it and run 'caphy register points' again")
    return {"train": train, "held_out": held_out}


def read_points(run: Path, part: Part) -> list[ScanPoints]:
    """The points of one side of a run's split, in its order."""
    return [ScanPoints.load(run / FOLDER / f"{name}.npz") for name in read_split(run)[part]]


def _of_these(known: dict[Part, list[str]], names: Sequence[str]) -> dict[Part, list[str]] | None:
    """What a split says of some scans, if it knows each of them and no side is left without any."""
    kept: dict[Part, list[str]] = {
        part: [name for name in given if name in set(names)] for part, given in known.items()
    }
    emptied = any(known[part] and not kept[part] for part in known)
    return None if emptied or len(kept["train"] + kept["held_out"]) < len(names) else kept
