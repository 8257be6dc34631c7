"""All rows of the table on all held-out scans of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.evaluate.classes import like_and_unlike, pose_distances
from caphy.evaluate.dressed import Dressed, Subject, Wearing
from caphy.evaluate.learnt_from import chosen_by_held_out, require_same_scans
from caphy.evaluate.perceptual import Perceptual
from caphy.evaluate.rows import PAPER, TEMPLATE, Row
from caphy.evaluate.score import HeldOut
from caphy.kept import digest
from caphy.register.points import ScanPoints, read_points
from caphy.scan.scan_set import ScanSet

FORMAT = "caphy-evaluation-1"
DEFINITION = (
    "Chamfer: visible points of the predicted clothes to the scan's clothes and back, nearest points on triangles; the "
    "root of half of POP's sum of the two mean squared distances (Ma et al. 2021), in mm"
)

Progress = Callable[[str, int, int], None]
Shown = Callable[[HeldOut, Mapping[str, Dressed]], None]
"""Given each scan with the first seed's prediction of every row, to picture them."""


@dataclass
class Evaluation:
    """What :func:`evaluate` found.

    rows: those asked for. scores: row -> seed folder -> scan -> figures. classes: class of each scan. distances: how
    far each scan's pose lies from the nearest trained one [degrees]. unused: scan, or one of its garments, -> why.
    chosen_by: garment -> scans held out by which its template was chosen all the same. failed: row -> why -> scans that
    it could not be held against for that, or none for all.
    """

    rows: tuple[Row, ...]
    classes: Mapping[str, str]
    distances: Mapping[str, float]
    trained_on: int
    look: Perceptual | None
    scores: dict[str, dict[str, dict[str, dict[str, float]]]] = field(default_factory=dict)
    unused: dict[str, str] = field(default_factory=dict)
    chosen_by: dict[str, list[str]] = field(default_factory=dict)
    failed: dict[str, dict[str, list[str]]] = field(default_factory=dict)

    @property
    def left_out(self) -> dict[str, str]:
        """Scan or row -> why it does not count, or not in everything."""
        rows = {
            row: "; ".join(f"{why} ({', '.join(scans)})" if scans else why for why, scans in reasons.items())
            for row, reasons in self.failed.items()
        }
        return self.unused | rows

    def figures(self, row: str, name: str | None = None) -> dict[str, dict[str, float]]:
        """Mean of each figure of a row over scans (of one class if named) and seeds, and the spread of seeds.

        Over those scans that every seed was held against and that have the figure. The spread is the standard deviation
        between seeds, each the mean over scans; 0 for a single seed.
        """
        seeds = list(self.scores.get(row, {}).values())
        scans = [
            scan
            for scan, own in self.classes.items()
            if seeds and all(scan in seed for seed in seeds) and (name is None or own == name)
        ]
        having: dict[str, list[str]] = {}
        for scan in scans:
            for key in seeds[0][scan]:
                having.setdefault(key, []).append(scan)
        means = {
            key: np.array([np.mean([seed[scan][key] for scan in chosen]) for seed in seeds])
            for key, chosen in having.items()
        }
        return {
            key: {"mean": float(value.mean()), "spread": float(value.std(ddof=1)) if len(value) > 1 else 0.0}
            for key, value in means.items()
        }

    def document(self) -> dict[str, Any]:
        """Everything, ready for JSON."""
        names = sorted(set(self.classes.values()))
        scored = {scan for seeds in self.scores.values() for scans in seeds.values() for scan in scans}
        done = [name for name in self.classes if name in scored]
        return {
            "format": FORMAT,
            "definition": DEFINITION,
            "perceptual": None
            if self.look is None
            else f"{self.look.name}: {self.look.definition}; mean over the pixels "
            "where scan or prediction shows somebody, four sides, both in the colours of labels",
            "trained_on": self.trained_on,
            "scans": {n: {"class": self.classes[n], "pose_distance_degrees": self.distances[n]} for n in done},
            "left_out": self.left_out,
            "templates_chosen_by_held_out": self.chosen_by,
            "rows": [self._row(row, names) for row in self.rows],
            "paper_mm": {name: list(values) for name, values in PAPER.items()},
        }

    def _row(self, row: Row, names: Sequence[str]) -> dict[str, Any]:
        scores = self.scores.get(row.name, {})
        return {
            "name": row.name,
            "missing": row.missing or (self.left_out.get(row.name) if not scores else None),
            "seeds": len(scores),
            "all": self.figures(row.name),
            "classes": {name: self.figures(row.name, name) for name in names},
            "scans": scores,
        }


def evaluate(
    run: Path, scans: ScanSet, rows: Sequence[Row], look: Perceptual | None,
    classes: Mapping[str, str] | None = None, progress: Progress | None = None, show: Shown | None = None,
) -> Evaluation:  # fmt: skip
    """Hold every row against the scans that the run's split holds out, and against no others.

    Args:
        run: folder that ``caphy register`` filled.
        scans: the labelled scans it was filled from.
        look: the perceptual error, or none.
        classes: motion class of each held-out scan; by default the half nearer to the trained poses, and the rest.

    Raises:
        CaphyError: nothing is held out, or not a single scan or row can be evaluated.
    """
    subject = Subject.read(run)
    held_out = read_points(run, "held_out")
    if not held_out:
        raise CaphyError(f"{run}: holds no scan out of training; give at least two scans, and train on the others")
    trained = read_points(run, "train")
    names = [points.name for points in held_out]
    distances = _distances(held_out, trained)
    classes = classes or like_and_unlike(names, distances)
    result = Evaluation(
        tuple(rows), {n: classes[n] for n in names}, dict(zip(names, np.degrees(distances).tolist(), strict=True)),
        len(trained), look,
    )  # fmt: skip
    result.chosen_by.update(chosen_by_held_out(run, tuple(subject.garments), names))
    worn = _read_rows(subject, rows, digest(trained), result)
    for number, points in enumerate(held_out):
        if progress is not None:
            progress("held-out scans", number, len(held_out))
        try:
            held = HeldOut(_scan(scans, points.name), points, tuple(subject.garments))
            shown = held.shown
        except CaphyError as error:
            result.unused[points.name] = str(error)
            continue
        result.unused |= {f"{points.name}, {kind}": why for kind, why in held.unshown.items()}
        first = _evaluate_scan(held, shown, worn, look, result)
        if show is not None and first:
            show(held, first)
    if not result.scores:
        raise CaphyError("nothing could be evaluated:\n" + "\n".join(result.left_out.values()))
    return result


def _distances(held_out: Sequence[ScanPoints], trained: Sequence[ScanPoints]) -> np.ndarray:
    poses, others = (np.stack([points.pose for points in side]) for side in (held_out, trained))
    return pose_distances(poses, others).min(axis=1)


def _read_rows(subject: Subject, rows: Sequence[Row], scans: str, result: Evaluation) -> dict[str, dict[str, Wearing]]:
    """Row -> seed folder -> its networks, of those that learnt from no scans but the ones with this digest."""
    worn: dict[str, dict[str, Wearing]] = {}
    for row in rows:
        if row.name == TEMPLATE:
            worn[row.name] = {TEMPLATE: subject.template()}
        for folder in row.folders:
            try:
                wearing = subject.wearing(folder)
                require_same_scans(folder, tuple(subject.garments), scans)
                worn.setdefault(row.name, {})[str(folder)] = wearing
            except CaphyError as error:  # a seed that is not whole, or knows too much; the row goes on with the others
                result.failed.setdefault(row.name, {})[str(error)] = []
    return {name: seeds for name, seeds in worn.items() if seeds}


def _scan(scans: ScanSet, name: str):
    if name not in scans.names:
        raise CaphyError(f"{scans.folder}: has no scan {name!r}, which the run holds out; give the same scans")
    return scans[scans.names.index(name)]


def _evaluate_scan(
    held: HeldOut, shown: Sequence[str], worn: Mapping[str, Mapping[str, Wearing]], look: Perceptual | None,
    result: Evaluation,
) -> dict[str, Dressed]:  # fmt: skip
    """Score every row and seed on the garments shown in one scan, as far as they can be.

    Returns:
        What each row's first seed that could makes of it.
    """
    first: dict[str, Dressed] = {}
    done: dict[str, tuple[Dressed, dict[str, float]]] = {}
    for row, seeds in worn.items():
        for seed, wearing in seeds.items():
            try:
                if seed not in done:  # the avatar's networks may stand in a row of the paper too
                    dressed = wearing.only(shown).held(held.points.pose, held.points.transl)
                    done[seed] = dressed, held.score(dressed, look)
            except CaphyError as error:
                result.failed.setdefault(row, {}).setdefault(f"{seed}: {error}", []).append(held.scan.name)
                continue
            dressed, figures = done[seed]
            result.scores.setdefault(row, {}).setdefault(seed, {})[held.scan.name] = figures
            first.setdefault(row, dressed)
    return first
