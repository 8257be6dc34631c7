"""A network carried over to a garment of another mesh, cut or body: cloth of like garments falls alike.

The GRU knows what poses do, and costs most to train; the head's rows are blend shapes of a garment's vertices. On
another garment a vertex takes the rows of the place of the first one that is nearest to it on the T-posed body.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from caphy.body.surface import NearestPoints, nearest_on_surface
from caphy.garment.template import Garment
from caphy.network.garment_network import GarmentNetwork


def carried_over(
    network: GarmentNetwork, faces: np.ndarray, garment: Garment, joints: np.ndarray
) -> tuple[GarmentNetwork, float]:
    """A network of ``garment`` that begins as ``network``, and how far apart the two are.

    Args:
        network: of a garment with these ``faces`` (F, 3).
        garment: another one, made on a body with rest ``joints`` (55, 3) [m].

    Returns:
        The network, and the median distance [m] of the garment's vertices from the other one once they follow the
        joints from their body to its. Joints that only the new network sees have no say at first.
    """
    found = _places(network, faces, garment, joints)
    new = GarmentNetwork(
        garment.vertices,
        garment.weights,
        joints,
        fps=network.fps,
        layers=network.gru.num_layers,
        width=network.gru.hidden_size,
    )
    corners = torch.from_numpy(np.asarray(faces, dtype=np.int64)[found.face])
    share = torch.from_numpy(found.barycentric).float()
    with torch.no_grad():
        new.gru.load_state_dict(network.gru.state_dict() | {"weight_ih_l0": _columns(network, new.driving)})
        for own, theirs in ((new.head.weight, network.head.weight), (new.head.bias, network.head.bias[:, None])):
            rows = theirs.unflatten(0, (-1, 3)).flatten(1)  # (V, 3 n)
            own.copy_(torch.einsum("vk,vkn->vn", share, rows[corners]).reshape(own.shape))
    return new, float(np.median(np.abs(found.distance)))


def _places(network: GarmentNetwork, faces: np.ndarray, garment: Garment, joints: np.ndarray) -> NearestPoints:
    """Where on the network's template the garment's vertices are, moved with their joints to its body."""
    moved = garment.vertices + garment.weights @ (network.joints.double().numpy() - joints)
    return nearest_on_surface(moved, network.template.double().numpy(), faces)


def _columns(network: GarmentNetwork, driving: Sequence[int]) -> torch.Tensor:
    """The first layer's input weights for other driving joints: six columns a joint, then what is the root's."""
    theirs = network.gru.state_dict()["weight_ih_l0"]
    by_joint = dict(zip(network.driving, theirs[:, : 6 * len(network.driving)].split(6, dim=1), strict=True))
    none = theirs.new_zeros(len(theirs), 6)
    return torch.cat([*(by_joint.get(joint, none) for joint in driving), theirs[:, 6 * len(network.driving) :]], dim=1)
