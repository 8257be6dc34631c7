"""What a fit keeps on disk while it runs, so that a stopped run goes on where it was; npz files without pickles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caphy.errors import CaphyError
from caphy.garment.template import read_npz, write_npz
from caphy.kept import digest, own_code
from caphy.register.articulation import Figure, Placement
from caphy.register.coarse import CoarseFit
from caphy.register.rounds import State
from caphy.register.starts import FirstFit


class Store:
    """A folder of intermediate results, each marked with what it was made from; without a folder nothing is kept."""

    def __init__(self, folder: Path | None):
        self.folder = folder

    def key(self, *of: object) -> str:
        """A digest of all that a result depends on, caphy's code among it."""
        return "" if self.folder is None else digest(own_code(), *of)

    def first(self, name: str, key: str) -> FirstFit | None:
        """The first fit of a scan, if kept."""
        kept = self._read(f"first/{name}.npz", key)
        if kept is None:
            return None
        fit = CoarseFit(Placement(kept["rotations"], kept["transl"]), kept["betas"], float(kept["misfit"]))
        return FirstFit(fit, float(kept["far"]), float(kept["unseen"]), bool(kept["estimated"]))

    def keep_first(self, name: str, key: str, first: FirstFit) -> None:
        """Keep a first fit."""
        fit = first.fit
        arrays = {"rotations": fit.placement.rotations, "transl": fit.placement.transl, "betas": fit.betas}
        told = {"misfit": fit.misfit, "far": first.far, "unseen": first.unseen, "estimated": first.estimated}
        numbers = {name: np.array(number) for name, number in told.items()}
        self._write(f"first/{name}.npz", key, arrays | numbers)

    def state(self, key: str, initial: State, again: int = 0) -> State | None:
        """The latest state of the rounds, run ``again`` so many times, if kept; ``initial`` tells the body."""
        kept = self._read(f"rounds/{again}.npz", key)
        if kept is None:
            return None
        placements = (Placement(r, t) for r, t in zip(kept["rotations"], kept["transl"], strict=True))
        figure = Figure(initial.figure.body, kept["betas"], kept["displacement"])
        return State(figure, tuple(placements), int(kept["done"]))

    def keep_state(self, key: str, state: State, again: int = 0) -> None:
        """Keep the rounds' state."""
        arrays = {
            "betas": state.figure.betas,
            "displacement": state.figure.displacement,
            "rotations": np.stack([p.rotations for p in state.placements]),
            "transl": np.stack([p.transl for p in state.placements]),
            "done": np.array(state.done),
        }
        self._write(f"rounds/{again}.npz", key, arrays)

    def _read(self, name: str, key: str) -> dict[str, np.ndarray] | None:
        if self.folder is None or not (self.folder / name).is_file():
            return None
        try:
            arrays = read_npz(self.folder / name)
        except CaphyError:  # half a disk's worth; made again
            return None
        return arrays if str(arrays.get("key")) == key else None

    def _write(self, name: str, key: str, arrays: dict[str, np.ndarray]) -> None:
        if self.folder is not None:
            write_npz(self.folder / name, {**arrays, "key": np.array(key)})
