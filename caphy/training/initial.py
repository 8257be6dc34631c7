"""Where a training starts from: a network that an avatar serves, or one that an earlier training left."""

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
from caphy.io.bundle import MANIFEST, read_bundle
from caphy.io.training_folder import MODEL, NETWORK, RECORD
from caphy.network.files import load_network
from caphy.network.from_graph import network_of
from caphy.network.garment_network import GarmentNetwork
from caphy.training.transfer import carried_over

SAME_JOINTS = 1e-4
"""Largest distance between the joints of a body and those a network was trained on [m]."""
ALIKE = 0.08
"""Median distance [m] beyond which a garment is no likeness of another, as a sleeve is none of a skirt."""


@dataclass(frozen=True, eq=False)
class Initial:
    """A trained network and what is known of its making.

    source: the folder it was read from. betas: body shape it was trained on. model: its physics model as JSON, empty if
    unknown. record: where it comes from, for the record of the training that goes on with it.
    """

    source: Path
    network: GarmentNetwork
    betas: tuple[float, ...]
    model: Mapping[str, Any]
    record: Mapping[str, Any]

    def require_joints(self, joints: np.ndarray) -> None:
        """Raise CaphyError unless rest joints (55, 3) [m] are those that the network was trained on."""
        gap = float(np.abs(self.network.joints.numpy() - joints).max())
        if gap > SAME_JOINTS:
            raise CaphyError(
                f"{self.source}: was trained on another body: joints differ by {1e3 * gap:.1f} mm; give that body with "
                "--body and its shape with --betas"
            )


def read_initial(folder: Path, garment: Garment) -> Initial:
    """The network of ``garment`` in an avatar bundle, or in a folder that ``caphy train`` wrote.

    A bundle holds the network as it is served, without rest shape or attachment; these are the garment's.

    Raises:
        CaphyError: the folder is neither, is damaged, or holds no network of this garment's mesh.
    """
    if (folder / MANIFEST).is_file():
        return _of_avatar(folder, garment)
    if not (folder / NETWORK).is_file():
        raise CaphyError(
            f"{folder}: is neither an avatar ({MANIFEST}) nor a folder that 'caphy train' wrote ({NETWORK})"
        )
    network, settings = load_network(folder / NETWORK), _json(folder / RECORD)
    _require_mesh(folder, {garment.name: network.template.numpy()}, garment)
    record = {"run": folder.resolve().name, "network_sha256": _sha256((folder / NETWORK).read_bytes())}
    return Initial(folder, network, tuple(settings.get("betas", ())), _json(folder / MODEL), record)


def read_likeness(folder: Path, garment: Garment, joints: np.ndarray) -> Initial:
    """The network of the garment in an avatar bundle that is most like ``garment``, carried over to it.

    Args:
        garment: of any mesh and cut.
        joints: rest joints (55, 3) [m] of the body it was made on.

    Returns:
        It, of no body shape and no model: those are the new garment's own.

    Raises:
        CaphyError: the folder is no avatar, is damaged, or no garment in it is like this one.
    """
    if not (folder / MANIFEST).is_file():
        raise CaphyError(f"{folder}: is not an avatar: it has no {MANIFEST}; 'caphy export' writes avatars")
    bundle = read_bundle(folder)
    found = []
    for worn in bundle.garments:
        network = network_of(worn, bundle.joints, bundle.fps)
        found.append((*carried_over(network, worn.mesh.faces, garment, joints), worn))
    network, apart, worn = min(found, key=lambda each: each[1])
    if apart > ALIKE:
        raise CaphyError(
            f"{folder}: none of its garments is like {garment.name!r}: {worn.name}, the nearest, lies "
            f"{100 * apart:.0f} cm from it, at most {100 * ALIKE:.0f} are allowed; leave --transfer out"
        )
    record = {
        "transferred_from": bundle.name,
        "garment": worn.name,
        "apart_mm": round(1e3 * apart, 1),
        "graph_sha256": _sha256(worn.onnx),
    }
    return Initial(folder, network, (), {}, record)


def _of_avatar(folder: Path, garment: Garment) -> Initial:
    bundle = read_bundle(folder)
    name = _require_mesh(folder, {g.name: g.mesh.vertices for g in bundle.garments}, garment)
    worn = bundle.garment(name)
    known = bundle.provenance.get("garments", {}).get(name, {})
    record = {"avatar": bundle.name, "garment": name, "graph_sha256": _sha256(worn.onnx)}
    network = network_of(worn, bundle.joints, bundle.fps)
    return Initial(folder, network, tuple(known.get("training", {}).get("betas", ())), known.get("model", {}), record)


def _require_mesh(folder: Path, templates: Mapping[str, np.ndarray], garment: Garment) -> str:
    """Which of the templates (V, 3) is the garment's."""
    for name, template in templates.items():
        if template.shape == garment.vertices.shape and np.allclose(template, garment.vertices, atol=1e-5):
            return name
    have = ", ".join(f"{name} of {len(template)} vertices" for name, template in templates.items())
    raise CaphyError(
        f"{folder}: has no network of the garment {garment.name!r} ({len(garment.vertices)} vertices), only {have}; "
        "give the garment npz that it was trained on, or carry a network over from another garment's with --transfer"
    )


def _json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text()) if path.is_file() else {}
    except (OSError, ValueError) as error:
        raise CaphyError(f"{path}: cannot be read as JSON: {error}") from error


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
