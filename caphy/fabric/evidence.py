"""What scans say of the fabric's numbers: the normal equations of two objectives, one scan at a time.

Force: CaPhy's E_param, the squared gradient of the potential at the cloth as it was seen. Response: the squared
distance of the points from the cloth at rest, whose change with a number a is that of the equilibrium,
dx/da = -H^-1 dg/da. Both are linear least squares in a change of the numbers; they weigh the same force residual, one
as it is, one through the compliance H^-1 of the cloth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from caphy.effects.base import BodyState
from caphy.fabric.coefficients import Coefficients
from caphy.fabric.states import Layer, Lying
from caphy.fabric.stills import Worn

FARTHEST = 0.012
"""Points farther than this from the cloth [m] are of a fold that the model has not got."""
CONTACT = {"body_contact.stiffness": 1e8, "body_contact.distance": 1e-3}
"""Numbers of the contact that are never believed, with the sizes they are told in [N/m^4], [m].

How deep cloth sinks into a penalty says how hard it presses, and so how stiff it is - on a simulated body. Skin is no
such scale, and a fitted body is millimetres off, so what these two numbers could explain is left to them."""


@dataclass(frozen=True, eq=False)
class Said:
    """Of one scan: the quadratic |r - J d|^2 = c - 2 b.d + d.A d of changes d of the N numbers and nuisances.

    Attributes:
        a, b, c: J^T J (N, N), J^T r (N,), r^T r.
        count: residuals.
        energy: of each of the K numbers per unit, at the cloth where it lies (K,) [J].
        first: what each table of the model that stiffness is told over stores there (G,) [J].
        median: of the points' distances from the cloth [m].
    """

    a: np.ndarray
    b: np.ndarray
    c: float
    count: int
    energy: np.ndarray
    first: np.ndarray
    median: float


def by_response(layer: Layer, worn: Worn, lying: Lying, numbers: Coefficients, mesh: np.ndarray | None = None) -> Said:
    """What a scan says through the change of the equilibrium; the layer's potential is aimed at the scan.

    ``mesh`` is how much farther out the cloth would lie at each of the scan's points on a finer mesh (N,) [m]; NaN
    where that is not known, and such points are not used.
    """
    x = torch.from_numpy(lying.x)
    body = worn.seen(x)
    pushes = torch.cat([numbers.forces(layer.potential, x, body), _contact(layer, x, body)])
    factor = layer.newton.factorize(x, None, lambda _: body)
    moved = -factor.solve(pushes.permute(1, 2, 0).contiguous().numpy())
    residual = lying.hits.residual(lying.x)
    near = np.abs(residual) < FARTHEST
    if mesh is not None:
        residual = residual - mesh[lying.hits.index]
        near &= np.isfinite(residual)
    r, j = residual[near], (lying.hits.rows @ moved.reshape(-1, moved.shape[-1]))[near]
    stored = numbers.energies(layer.potential, x), numbers.stored_first(layer.potential, x)
    return Said(j.T @ j, j.T @ r, float(r @ r), len(r), *stored, float(np.median(np.abs(r))))


def of_the_mesh(lying: Lying, fine: Lying, count: int) -> np.ndarray:
    """How much farther out the cloth lies on a finer mesh at each of ``count`` points of a scan (N,) [m], or NaN."""
    found = np.full((2, count), np.nan)
    for row, one in zip(found, (lying, fine), strict=True):
        row[one.hits.index] = one.hits.residual(one.x)
    return found[0] - found[1]


def by_force(layer: Layer, worn: Worn, lying: Lying, numbers: Coefficients, values: np.ndarray) -> Said:
    """What a scan says through the forces at the cloth as it was drawn to the points; numbers (K,) are the layer's."""
    layer.potential.aim(None, 0.0)
    x = torch.from_numpy(lying.drawn)
    body = worn.seen(x)
    pushes = torch.cat([numbers.forces(layer.potential, x, body), _contact(layer, x, body)])
    j = -pushes.reshape(len(pushes), -1).T.numpy()
    r = layer.potential.gradient(x, None, body)[1].reshape(-1).numpy()
    stored = numbers.energies(layer.potential, x), numbers.stored_first(layer.potential, x)
    residual = lying.hits.residual(lying.x)
    return Said(j.T @ j, j.T @ r, float(r @ r), len(r), *stored, float(np.median(np.abs(residual))))


def _contact(layer: Layer, x: torch.Tensor, body: BodyState) -> torch.Tensor:
    """Derivatives of the gradient by the contact's numbers (2, V, 3), in their sizes; zeros without contact."""
    if "body_contact" not in layer.potential.terms:
        return x.new_zeros((len(CONTACT), *x.shape))
    found = layer.potential.parameter_gradients(x, None, body, set(CONTACT))
    return torch.stack([size * found[name] for name, size in CONTACT.items()])
