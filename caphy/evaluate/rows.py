"""The rows of CaPhy's table, and where a run keeps the networks of each."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from caphy.errors import CaphyError
from caphy.evaluate.dressed import KINDS
from caphy.io.bundle import MANIFEST
from caphy.io.training_folder import NETWORK

TEMPLATE: Final = "skinned template"
"""A row that needs no training."""
DATA_ONLY, SNUG, NO_DATA = "data-only", "SNUG", "ours without real data"
NO_PHYSICS, OURS = "ours without optimised physics", "ours"
AVATAR: Final = "avatar"
"""A row of what the run's avatar is made of, whichever networks the paper's rows hold."""
LAST: Final = ("collided", "fabric", "train")
"""Folders of a run's networks, those trained last first: its avatar is made of the first that has all garments."""
PAPER: Final = {DATA_ONLY: (7.0, 8.2), SNUG: (10.8, 13.3), OURS: (6.76, 7.35)}
"""What CaPhy reports for its two subjects [mm]; other people, other scans, other clothes."""


@dataclass(frozen=True)
class Row:
    """One row of the table: networks of one kind of training, one folder per seed."""

    name: str
    folders: tuple[Path, ...] = ()
    """Each holds a network for every garment, or an avatar; none for :data:`TEMPLATE`."""
    missing: str | None = None
    """Why it cannot be evaluated."""


def known_rows(run: Path) -> list[Row]:
    """All rows, in the paper's order, then the avatar's, if there is one; those never trained say so."""
    rows = [Row(TEMPLATE)]
    for name, places in _places(run).items():
        seeds = next((found for place in places if (found := seed_folders(run / place))), ())
        rows.append(Row(name, seeds, None if seeds else f"not trained (no networks in {' or '.join(places)})"))
    kinds = worn(run)
    whole = [run / last for last in LAST if kinds and all((run / last / kind / NETWORK).is_file() for kind in kinds)]
    return rows + [Row(AVATAR, (folder,)) for folder in whole[:1]]


def worn(run: Path) -> list[str]:
    """The garments of which a run has a template."""
    return [kind for kind in KINDS if (run / f"{kind}.npz").is_file()]


def _places(run: Path) -> dict[str, tuple[str, ...]]:
    """Where a row's networks lie in a run's folder: the first of these that is there.

    What was trained last counts as ours only if a number of the fabric had been found before.
    """
    optimised, last = fabrics_found(run), ("collided", "fabric")
    return {
        DATA_ONLY: ("rows/data_only",),
        SNUG: ("rows/snug",),
        NO_DATA: ("rows/no_data",),
        NO_PHYSICS: ("rows/default_physics", "train") if optimised else ("rows/default_physics", *last, "train"),
        OURS: ("rows/ours", *last) if optimised else ("rows/ours",),
    }


def fabrics_found(run: Path) -> list[str]:
    """The garments of which 'caphy fabric' determined a table; of others it kept those that training began with."""
    try:
        garments = json.loads((run / "fabric.json").read_text(encoding="utf-8"))["garments"]
        tables = {kind: garment["stiffness"].values() for kind, garment in garments.items()}
        return [kind for kind, each in tables.items() if any(table["interval"] is not None for table in each)]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []


def seed_folders(folder: Path) -> tuple[Path, ...]:
    """The folders of networks in ``folder``: itself, or its ``seed_*``, sorted."""
    if _holds_networks(folder):
        return (folder,)
    return tuple(sorted(seed for seed in folder.glob("seed_*") if _holds_networks(seed)))


def given_row(text: str) -> Row:
    """The row of NAME=FOLDER; raises CaphyError where the folder holds neither networks nor an avatar."""
    name, _, folder = text.partition("=")
    if not name or not folder:
        raise CaphyError(f"a row must be given as NAME=FOLDER, got {text!r}")
    if name == TEMPLATE:
        raise CaphyError(f"{text!r}: the row {TEMPLATE!r} is that of clothes without a network; give another name")
    seeds = seed_folders(Path(folder))
    if not seeds:
        raise CaphyError(
            f"{folder}: holds no networks; it must be an avatar, or hold upper/{NETWORK} and lower/{NETWORK} (or "
            "seed_1, seed_2 ... that do)"
        )
    return Row(name, seeds)


def _holds_networks(folder: Path) -> bool:
    return (folder / MANIFEST).is_file() or any((folder / kind / NETWORK).is_file() for kind in KINDS)
