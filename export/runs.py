"""What a training leaves in its folder, as far as an avatar needs it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.network.files import load_network
from caphy.network.garment_network import GarmentNetwork

NETWORK = "network.safetensors"
GARMENT = "garment.npz"
SETTINGS = "run.json"
METRICS = "metrics.jsonl"


@dataclass(frozen=True, eq=False)
class Run:
    """A trained network, its garment, how it was trained, and the last validation on held-out clips."""

    garment: Garment
    network: GarmentNetwork
    provenance: Mapping[str, Any]
    metrics: Mapping[str, Any]


def read_run(folder: Path) -> Run:
    """Read a folder that ``caphy train`` wrote; raises CaphyError where garment and network are missing or differ."""
    network = load_network(folder / NETWORK)
    garment = Garment.load(folder / GARMENT)
    if network.template.shape != garment.vertices.shape or not np.allclose(
        network.template.numpy(), garment.vertices, atol=1e-5
    ):
        raise CaphyError(f"{folder}: {GARMENT} is not the garment that {NETWORK} was trained on; train again")
    digest = hashlib.sha256((folder / NETWORK).read_bytes()).hexdigest()
    provenance = {"garment": dict(garment.provenance), "network_sha256": digest, "training": _settings(folder)}
    return Run(garment, network, provenance, _last_validation(folder))


def _settings(folder: Path) -> dict[str, Any]:
    path = folder / SETTINGS
    return json.loads(path.read_text()) if path.is_file() else {}


def _last_validation(folder: Path) -> dict[str, Any]:
    path = folder / METRICS
    lines = path.read_text().splitlines() if path.is_file() else []
    validations = [line for line in lines if '"validation"' in line]
    return json.loads(validations[-1])["validation"] if validations else {}
