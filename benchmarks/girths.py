"""Girths of registered garments against the true ones of a virtual rig: area of cloth, by the joint that it follows.

    python -m benchmarks.girths GARMENTS SESSION

GARMENTS is the folder that ``caphy register garments`` wrote, SESSION the one of ``caphy capture-sim``. With lengths
right, the area of a sleeve, a leg or the trunk over the true one is its girth over the true one. Single eases and
flares are no such measure: they make up for each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from caphy.capture.session import read_subject
from caphy.conventions import JOINT_NAMES
from caphy.garment.template import Garment
from caphy.garment.topology import face_areas

LEAST = 0.01
"""Of the true cloth's area [m^2]: what a joint must carry to be told."""


@dataclass(frozen=True)
class Options:
    """What to compare."""

    garments: tyro.conf.Positional[Path]
    session: tyro.conf.Positional[Path]


def main(options: Options) -> None:
    """Print a line for each garment."""
    true = read_subject(options.session / "truth").garments
    for kind in sorted(path.stem for path in options.garments.glob("*.npz") if path.stem in true):
        found, wanted = _areas(Garment.load(options.garments / f"{kind}.npz")), _areas(true[kind])
        told = [f"{JOINT_NAMES[j]} {found[j] / wanted[j]:.2f}" for j in np.flatnonzero(wanted > LEAST)]
        print(f"{kind}: all {found.sum() / wanted.sum():.3f}; {', '.join(told)}")


def _areas(garment: Garment) -> np.ndarray:
    """Area of the faces that mostly follow each joint (55,) [m^2]."""
    joint = garment.weights[garment.faces].sum(axis=1).argmax(axis=1)
    return np.bincount(joint, face_areas(garment.vertices, garment.faces), minlength=len(JOINT_NAMES))


if __name__ == "__main__":
    main(tyro.cli(Options))
