"""Supervision by the scans of a run, for the commands that train: which points are whose, and who hides whom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from caphy.errors import CaphyError

if TYPE_CHECKING:
    from caphy.garment.template import Garment
    from caphy.network.garment_network import GarmentNetwork
    from caphy.register.points import ScanPoints
    from caphy.training.objective import Objective
    from caphy.training.scans import Scans

PARTS = ("upper", "lower")


def supervision(
    run: Path,
    worn: str,
    outermost: str | None,
    objective: Objective,
    network: GarmentNetwork,
    weight: float,
    physics: bool = True,
) -> Scans:
    """Supervision of the garment ``worn`` ("upper", "lower") by the training scans of a run; see :class:`Scans`.

    Scans that do not show it are left out. Mirror images are added where the body and all that is worn are the same on
    both sides.

    Raises:
        CaphyError: no scan shows the garment.
    """
    from caphy.register.points import read_points
    from caphy.training.mirrored import symmetric, with_mirror_images
    from caphy.training.scans import Scans

    points = read_points(run, "train")
    outermost = outermost or innermost_of_run(run, points, objective)[-1]
    over = () if outermost == worn else (outermost,)
    points, left_out = _showing(points, worn)
    cloth = objective.potential.cloth
    skin, joints = objective.body.rest(objective.betas)
    surfaces = [(skin, objective.body.faces), (cloth.vertices, cloth.faces)]
    surfaces += [(garment.vertices, garment.faces) for garment in templates(run)]
    if symmetric(surfaces):
        points = with_mirror_images(points, joints[0])
    scans = Scans.of(points, worn, over, objective, network.driving, weight, physics)
    return replace(scans, left_out=left_out)


def _showing(points: Sequence[ScanPoints], worn: str) -> tuple[list[ScanPoints], tuple[str, ...]]:
    """The scans that show the garment ``worn``, and in words why the others do not."""
    from caphy.training.counterparts import require_shown

    shown, left_out = [], []
    for scan in points:
        try:
            require_shown(scan, worn)
            shown.append(scan)
        except CaphyError as error:
            left_out.append(str(error))
    if not shown:
        raise CaphyError("\n".join([f"no scan to train on shows the {worn} garment:", *left_out]))
    return shown, tuple(left_out)


def worn_part(path: Path, garment: Garment) -> str:
    """Whether a garment is the upper or the lower one, by its file's name or its family.

    Raises:
        CaphyError: neither tells.
    """
    from caphy.register.styles import KINDS

    if path.stem in KINDS:
        return path.stem
    for worn, families in KINDS.items():
        if garment.provenance.get("family", garment.name) in families:
            return worn
    raise CaphyError(f"{path}: cannot tell whether {garment.name!r} is the upper or the lower garment; say with --worn")


def templates(run: Path) -> list[Garment]:
    """The garments that a run holds."""
    from caphy.garment.template import Garment

    return [Garment.load(run / f"{part}.npz") for part in PARTS if (run / f"{part}.npz").is_file()]


def innermost_of_run(run: Path, points: Sequence[ScanPoints], objective: Objective) -> list[str]:
    """The parts from the inside out, as the scans show it where the run holds both templates."""
    from caphy.garment.template import Garment
    from caphy.training.scans import innermost_first, scan_motions

    if not all((run / f"{part}.npz").is_file() for part in PARTS):
        return ["lower", "upper"]
    both = {part: Garment.load(run / f"{part}.npz") for part in PARTS}
    motions = scan_motions(points, objective.body, [0], 1 / objective.dt, objective.betas)
    return innermost_first(points, {part: (g.vertices, g.weights) for part, g in both.items()}, motions)
