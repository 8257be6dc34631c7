"""What is trained: the network's GRU, and its head in coordinates in which the cloth is equally stiff everywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import csc_array
from torch import Tensor, nn

from caphy.effects.base import BodyState, Step, lending
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect
from caphy.network.garment_network import GarmentNetwork
from caphy.solve.assembly import Hessian
from caphy.training.preconditioner import Preconditioner


def stiffness(potential: Potential, fps: float) -> csc_array:
    """Mean stiffness against displacements in x, y and z at the template, (V, V) [N/m]: elasticity and inertia.

    The average of the three diagonal blocks of the potential's Hessian, contact left out: it stiffens what is stretched
    between vertices and leaves cheap what moves them together. It is positive definite because inertia is, which it
    counts where the model is without it, too.
    """
    model = _without_contact(potential.model)
    free = Potential(model if "inertia" in model.effects else model.with_effect("inertia"), potential.cloth)
    x = torch.from_numpy(np.asarray(potential.cloth.vertices, dtype=np.float64))
    still = BodyState(x, torch.zeros_like(x), torch.zeros_like(x), x)
    hessian = Hessian(free)
    matrix = hessian.matrix(hessian.values(x, Step.implicit_euler(1 / fps, x, x), still))
    return csc_array(sum(matrix[axis::3, axis::3] for axis in range(3)) / 3)


def _without_contact(model: Model) -> Model:
    """The model without contact and without what reads it."""
    reads = {name for name in model.effects if "body_contact" in lending(find_effect(name), model.effects)}
    kept = {name: values for name, values in model.effects.items() if name not in {"body_contact", *reads}}
    return replace(model, effects=kept)


class Learner(nn.Module):
    """Features to offsets, as :meth:`GarmentNetwork.offsets`, with the head's output u = S z made of trained z.

    The minimum and the network are the same as without S. It starts as the network is: the head is divided by S here,
    and :meth:`fold` multiplies it into the network's head.
    """

    def __init__(self, network: GarmentNetwork, stiff: csc_array) -> None:
        """``stiff`` (V, V) [N/m] is what S is made of, see :class:`Preconditioner`."""
        super().__init__()
        self.gru = network.gru
        self.head = nn.Linear(network.head.in_features, network.head.out_features)  # rows: x of all, y of all, z
        self.preconditioner = Preconditioner(stiff)
        with torch.no_grad():
            self.head.weight.copy_(self._divided(network.head.weight))
            self.head.bias.copy_(self._divided(network.head.bias[:, None])[:, 0])
        # A network that was read is in evaluation mode, in which cuDNN differentiates no recurrent layer.
        self.train()

    def forward(self, features: Tensor, hidden: Tensor, last: bool = False) -> tuple[Tensor, Tensor]:
        """Canonical offsets (B, T, V, 3) [m] of features (B, T, D), and the hidden state (layers, B, width).

        With ``last`` the offsets are the last frame's alone, (B, 1, V, 3).
        """
        output, after = self.gru(features, hidden)
        z = self.head(output[:, -1:] if last else output).unflatten(-1, (3, -1))
        return self._times(z).mT, after

    @torch.no_grad()
    def fold(self, network: GarmentNetwork) -> None:
        """Set the network's head to this one's."""
        weight, bias = self.head.weight, self.head.bias
        network.head.weight.copy_(self._times(weight.mT.unflatten(-1, (3, -1))).permute(2, 1, 0).flatten(0, 1))
        network.head.bias.copy_(self._times(bias.unflatten(0, (3, -1))).mT.flatten())

    def _times(self, z: Tensor) -> Tensor:
        """S z along the last axis (..., V)."""
        return self.preconditioner.times(z.flatten(0, -2).T).T.unflatten(0, z.shape[:-1])

    def _divided(self, head: Tensor) -> Tensor:
        """S^-1 of a head's rows (3V, n), which are x, y, z of each vertex; the result's are x of all, y of all, z."""
        planes = head.unflatten(0, (-1, 3)).flatten(1)  # (V, 3 n)
        return self.preconditioner.solved(planes).unflatten(1, (3, -1)).transpose(0, 1).flatten(0, 1)
