"""A subject wearing what a trained network, or an avatar, makes of a pose that is held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from caphy.body.model import BodyModel
from caphy.errors import CaphyError
from caphy.garment.template import Garment
from caphy.io.bundle import MANIFEST, read_bundle
from caphy.io.training_folder import NETWORK
from caphy.network.files import load_network
from caphy.network.from_graph import network_of
from caphy.network.garment_network import GarmentNetwork
from caphy.register.subject import SUBJECT_BODY
from caphy.report.sight import ray_caster
from caphy.training.validate import static_drape

KINDS: Final = ("upper", "lower")
"""Of garments, the innermost last."""
SAME_JOINTS: Final = 1e-3
"""Largest distance between the subject's joints and those a network was trained on [m]."""
SAME_TEMPLATE: Final = 1e-5
"""The same of the coordinates of templates [m], which networks keep in single precision."""


@dataclass(frozen=True, eq=False)
class Subject:
    """The person of a run: body and garments, as the registration found them."""

    body: BodyModel
    garments: Mapping[str, Garment]
    """upper, lower, or one of them."""

    @classmethod
    def read(cls, run: Path) -> Subject:
        """The subject of a folder that ``caphy register`` filled; raises CaphyError where something is missing."""
        garments = {kind: Garment.load(run / f"{kind}.npz") for kind in KINDS if (run / f"{kind}.npz").is_file()}
        if not garments:
            raise CaphyError(f"{run}: holds neither upper.npz nor lower.npz; 'caphy register garments' writes them")
        return cls(BodyModel.load(run / SUBJECT_BODY), garments)

    def template(self) -> Wearing:
        """The garments as skinning alone carries them."""
        networks = {
            kind: GarmentNetwork(garment.vertices, garment.weights, self.body.joints, layers=1, width=8)
            for kind, garment in self.garments.items()
        }
        return Wearing(self, networks)

    def wearing(self, folder: Path) -> Wearing:
        """The networks in a folder's ``upper`` and ``lower``, as 'caphy train' writes them, or those of an avatar.

        Raises:
            CaphyError: a garment is missing, or was trained on another body or template.
        """
        if (folder / MANIFEST).is_file():
            networks = self._of_avatar(folder)
        else:
            networks = {kind: load_network(folder / kind / NETWORK) for kind in self.garments}
        for kind, network in networks.items():
            self._require(network, kind, folder)
        return Wearing(self, networks)

    def _of_avatar(self, folder: Path) -> dict[str, GarmentNetwork]:
        bundle = read_bundle(folder)
        found = {}
        for kind, garment in self.garments.items():
            same = [worn for worn in bundle.garments if np.array_equal(worn.mesh.faces, garment.faces)]
            if not same:
                raise CaphyError(f"{folder}: none of its garments has the mesh of this subject's {kind} garment")
            found[kind] = network_of(same[0], bundle.joints, bundle.fps)
        return found

    def _require(self, network: GarmentNetwork, kind: str, folder: Path) -> None:
        worn, own = self.garments[kind].vertices, network.template.numpy()
        if own.shape != worn.shape or not np.allclose(own, worn, rtol=0, atol=SAME_TEMPLATE):
            apart = f"{len(own)} vertices, not {len(worn)}" if len(own) != len(worn) else "another shape"
            raise CaphyError(
                f"{folder}: its {kind} garment was trained on another template than the subject's {kind}.npz, of "
                f"{apart}; train it on that"
            )
        gap = float(np.abs(network.joints.numpy() - self.body.joints).max())
        if gap > SAME_JOINTS:
            raise CaphyError(
                f"{folder}: its {kind} garment was trained on another body: joints differ by {1e3 * gap:.1f} mm; train "
                f"it with --body RUN/{SUBJECT_BODY}"
            )


@dataclass(frozen=True, eq=False)
class Wearing:
    """A subject and one network for each garment."""

    subject: Subject
    networks: Mapping[str, GarmentNetwork]

    def only(self, kinds: Sequence[str]) -> Wearing:
        """The same without the other garments."""
        return replace(self, networks={kind: self.networks[kind] for kind in kinds})

    def held(self, pose: np.ndarray, transl: np.ndarray) -> Dressed:
        """The subject in a pose (55, 3) [rad] at ``transl`` (3,) [m] that is held until the cloth has settled."""
        place = torch.tensor(pose, dtype=torch.float32), torch.tensor(transl, dtype=torch.float32)
        meshes = {
            kind: (static_drape(network, *place).double().numpy(), self.subject.garments[kind].faces)
            for kind, network in self.networks.items()
        }
        for kind, (vertices, _) in meshes.items():
            if not np.isfinite(vertices).all():
                raise CaphyError(f"the {kind} garment's network gives vertices that are not finite; train it again")
        return Dressed(self.subject.body.pose(pose[None], transl[None])[0], self.subject.body.faces, meshes)


@dataclass(frozen=True, eq=False)
class Dressed:
    """A dressed body in one pose, lengths in metres, y up."""

    body: np.ndarray
    """(B, 3)."""
    body_faces: np.ndarray
    """(F, 3)."""
    garments: Mapping[str, tuple[np.ndarray, np.ndarray]]
    """Vertices (V, 3) and faces (F, 3) of upper, lower, or one of them."""

    @cached_property
    def caster(self) -> Any:
        """All surfaces together, ready for rays."""
        return ray_caster([(self.body, self.body_faces), *self.garments.values()])
