"""What is trained: the network's GRU, and its head in coordinates in which the cloth is equally stiff everywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.linalg import solve_triangular
from torch import Tensor, nn

from caphy.effects.base import BodyState, Step
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.effects.registry import find_effect
from caphy.network.garment_network import GarmentNetwork
from caphy.solve.assembly import Hessian

TYPICAL_OFFSET = 0.01
"""Root-mean-square offset that the head makes of outputs of one [m]."""


def stiffness(potential: Potential, fps: float) -> np.ndarray:
    """Mean stiffness against displacements in x, y and z at the template, (V, V) [N/m]: elasticity and inertia.

    The average of the three diagonal blocks of the potential's Hessian, contact left out: it stiffens what is stretched
    between vertices and leaves cheap what moves them together. It is positive definite because inertia is.
    """
    free = Potential(_without_contact(potential.model), potential.cloth)
    x = torch.from_numpy(np.asarray(potential.cloth.vertices, dtype=np.float64))
    still = BodyState(x, torch.zeros_like(x), torch.zeros_like(x), x)
    hessian = Hessian(free)
    matrix = hessian.matrix(hessian.values(x, Step.implicit_euler(1 / fps, x, x), still))
    return np.mean([matrix[axis::3, axis::3].toarray() for axis in range(3)], axis=0)


def _without_contact(model: Model) -> Model:
    """The model without contact and without what reads it."""
    reads = {name for name in model.effects if "body_contact" in (find_effect(name).lenders(model.effects) or ())}
    kept = {name: values for name, values in model.effects.items() if name not in {"body_contact", *reads}}
    return replace(model, effects=kept)


def offset_basis(stiff: np.ndarray) -> np.ndarray:
    """S (V, V) with S S^T proportional to the inverse of a stiffness matrix (V, V); rms of S z is 1 cm for white z.

    A gradient step of size e in z = S^-1 u moves the offsets u by -e S S^T g: a Newton step of the linear cloth, where
    one in u itself is limited by the stiffest wave of one edge's length (Sobolev preconditioning; Renka and
    Neuberger, SIAM J. Sci. Comput. 16, 1995).
    """
    lower = np.linalg.cholesky(stiff)
    basis = solve_triangular(lower, np.eye(len(lower)), lower=True).T
    return basis * (TYPICAL_OFFSET / np.sqrt((basis * basis).sum(1).mean()))


class Learner(nn.Module):
    """Features to offsets, as :meth:`GarmentNetwork.offsets`, with the head's output u = S z made of trained z.

    The minimum and the network are the same as without S. It starts as the network is: the head is divided by S here,
    and :meth:`fold` multiplies it into the network's head.
    """

    basis: Tensor

    def __init__(self, network: GarmentNetwork, basis: np.ndarray) -> None:
        super().__init__()
        self.gru = network.gru
        self.head = nn.Linear(network.head.in_features, network.head.out_features)  # rows: x of all, y of all, z
        self.register_buffer("basis", torch.tensor(basis, dtype=torch.float32), persistent=False)
        with torch.no_grad():
            self.head.weight.copy_(_divided(network.head.weight, basis))
            self.head.bias.copy_(_divided(network.head.bias[:, None], basis)[:, 0])

    def forward(self, features: Tensor, hidden: Tensor, last: bool = False) -> tuple[Tensor, Tensor]:
        """Canonical offsets (B, T, V, 3) [m] of features (B, T, D), and the hidden state (layers, B, width).

        With ``last`` the offsets are the last frame's alone, (B, 1, V, 3).
        """
        output, after = self.gru(features, hidden)
        z = self.head(output[:, -1:] if last else output).unflatten(-1, (3, -1))
        return (z @ self.basis.T).mT, after

    @torch.no_grad()
    def fold(self, network: GarmentNetwork, weight: Tensor | None = None, bias: Tensor | None = None) -> None:
        """Set the network's head to this one's, or to ``weight`` (3V, width) and ``bias`` (3V,) given in its place."""
        weight = self.head.weight if weight is None else weight
        bias = self.head.bias if bias is None else bias
        network.head.weight.copy_((self.basis @ weight.unflatten(0, (3, -1))).transpose(0, 1).flatten(0, 1))
        network.head.bias.copy_((self.basis @ bias.unflatten(0, (3, -1)).mT).flatten())


def _divided(head: Tensor, basis: np.ndarray) -> Tensor:
    """S^-1 of a head's rows (3V, n), which are x, y, z of each vertex; the result's are x of all, y of all, z."""
    planes = head.detach().cpu().double().unflatten(0, (-1, 3)).transpose(0, 1)
    return torch.linalg.solve(torch.tensor(basis, dtype=torch.float64), planes).flatten(0, 1)
