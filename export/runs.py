"""What a training leaves in its folder, as far as an avatar needs it."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.io.poses.parts import file_of
from caphy.io.training_folder import GARMENT, METRICS, MODEL, NETWORK, RECORD
from caphy.network.files import load_network
from caphy.network.garment_network import GarmentNetwork
from caphy.training.loop import read_metrics

VALIDATION = "validation.json"


@dataclass(frozen=True, eq=False)
class Run:
    """A trained network, its garment, how it was trained, and what was measured on held-out clips.

    betas: body shape (S,) that it was trained on, or none. held_out: sources of motions that it did not see
    (:mod:`caphy.io.poses.parts`), as far as their files still exist.
    """

    garment: Garment
    network: GarmentNetwork
    betas: np.ndarray | None
    held_out: tuple[str, ...]
    provenance: Mapping[str, Any]
    metrics: Mapping[str, Any]


def read_run(folder: Path, say: Callable[[str], None] = print) -> Run:
    """Read a folder that ``caphy train`` wrote; ``say`` is told what in it is of another network.

    Raises
        CaphyError: where garment and network are missing or differ, or what was measured of them is not finite.
    """
    network = load_network(folder / NETWORK)
    garment = Garment.load(folder / GARMENT)
    if network.template.shape != garment.vertices.shape or not np.allclose(
        network.template.numpy(), garment.vertices, atol=1e-5
    ):
        raise CaphyError(f"{folder}: {GARMENT} is not the garment that {NETWORK} was trained on; train again")
    settings, model = _json(folder / RECORD), _json(folder / MODEL)
    held_out = tuple(name for name in settings.pop("held_out_paths", []) if Path(file_of(name)).is_file())
    settings.pop("body", None)  # a path on the machine it was trained on
    digest = hashlib.sha256((folder / NETWORK).read_bytes()).hexdigest()
    provenance = {
        "garment": dict(garment.provenance),
        "training": settings,
        "model": model,
        "network_sha256": digest,
    }
    betas = np.array(settings["betas"]) if settings.get("betas") else None
    return Run(garment, network, betas, held_out, provenance, _measured(folder, digest, say))


def _json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text()) if path.is_file() else {}


def _measured(folder: Path, digest: str, say: Callable[[str], None]) -> dict[str, Any]:
    """The trainer's last validation, and what ``caphy validate`` found beside the solver of the network of a digest."""
    path = folder / METRICS
    validations = [entry["validation"] for entry in read_metrics(path) if "validation" in entry]
    last = validations[-1] if validations else {}
    wrong = [key for key, value in _numbers(last) if not math.isfinite(value)]
    if wrong:
        raise CaphyError(
            f"{path}: what was measured on held-out motions must be finite, {wrong[0]} is not; the training came to "
            "nothing. Check the garment with 'caphy garment info' and the model's parameters, and train again"
        )
    beside = _json(folder / VALIDATION)
    if beside and beside.pop("network_sha256", None) != digest:
        say(f"note: {folder / VALIDATION} is of another network and left out; measure this one with 'caphy validate'")
        beside = {}
    wrong = [key for key, value in _numbers(beside) if not math.isfinite(value)]
    if wrong:
        say(f"note: {folder / VALIDATION} is left out, {wrong[0]} in it is not finite; measure with 'caphy validate'")
        beside = {}
    return last | ({"beside_solver": beside} if beside else {})


def _numbers(measured: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for key, value in measured.items():
        yield from _numbers(value) if isinstance(value, Mapping) else [(key, float(value))]
