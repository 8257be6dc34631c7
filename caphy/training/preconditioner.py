"""Coordinates in which a cloth is equally stiff everywhere, kept as a sparse factor of its stiffness."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csc_array, sparray, tril
from scipy.sparse.linalg import splu
from torch import Tensor

from caphy.jit import compiled

TYPICAL_OFFSET = 0.01
"""Root-mean-square offset that the coordinates make of white ones of one [m]."""

_AT_ONCE = 256  # columns: bounds memory

_compiled = compiled(nogil=True, fastmath={"contract"}, error_model="numpy", boundscheck=False)


class Preconditioner:
    """S (V, V) with S S^T proportional to the inverse of a stiffness matrix (V, V); rms of S z is 1 cm for white z.

    A gradient step of size e in z = S^-1 u moves the offsets u by -e S S^T g: a Newton step of the linear cloth, where
    one in u itself is limited by the stiffest wave of one edge's length (Sobolev preconditioning; Renka and
    Neuberger, SIAM J. Sci. Comput. 16, 1995).

    With K = L D L^T, S is L^-T D^-1/2. S is dense and L is not: for 2,355 vertices it holds 440,000 numbers. In the
    order that fills L least it would hold 125,000, but Adam, which steps along the axes of z, learns slower there:
    1,500 steps end at 2.41 J instead of 2.33 (one run of each), and with the symmetric root in the place of S higher
    still. On other devices than the CPU, which are slow at triangles, S is a matrix.
    """

    def __init__(self, stiffness: sparray) -> None:
        """``stiffness`` is symmetric and positive definite, (V, V) [N/m]."""
        factors = splu(
            csc_array(stiffness), permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        pivots = factors.U.diagonal()
        if not (np.array_equal(factors.perm_r, np.arange(len(pivots))) and (pivots > 0).all()):
            raise ArithmeticError("the stiffness matrix is not positive definite")
        self._lower, self._root = csc_array(tril(factors.L, -1)), np.sqrt(pivots)
        self._values = {np.dtype(kind): self._lower.data.astype(kind) for kind in (np.float32, np.float64)}
        self._dense: Tensor | None = None
        self._scale = 1.0
        square = sum(
            float((self.times(white) ** 2).sum())
            for white in torch.eye(len(self._root), dtype=torch.float64).split(_AT_ONCE, dim=1)
        )
        self._scale = TYPICAL_OFFSET / np.sqrt(square / len(self._root))

    def times(self, z: Tensor) -> Tensor:
        """S z of columns (V, n)."""
        if z.device.type == "cpu":
            return _Times.apply(self, z)
        if self._dense is None or self._dense.device != z.device:
            self._dense = self.times(torch.eye(len(self._root), dtype=torch.float64)).to(z)
        return self._dense @ z

    def solved(self, u: Tensor) -> Tensor:
        """S^-1 u of columns (V, n) in double precision, on the CPU."""
        u = u.detach().cpu().double()
        return torch.from_numpy(self._root[:, None] * (u.numpy() + self._lower.T @ u.numpy()) / self._scale)

    def forward(self, z: np.ndarray) -> np.ndarray:
        """S z."""
        x = np.array(z * (self._scale / self._root).astype(z.dtype)[:, None], order="C")
        _solve_upper(*self._factor(z.dtype), x)
        return x

    def backward(self, g: np.ndarray) -> np.ndarray:
        """S^T g."""
        x = np.array(g, order="C")
        _solve_lower(*self._factor(g.dtype), x)
        x *= (self._scale / self._root).astype(g.dtype)[:, None]
        return x

    def _factor(self, kind: np.dtype) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._lower.indptr, self._lower.indices, self._values[kind]


class _Times(torch.autograd.Function):
    """S z (V, n), differentiable."""

    @staticmethod
    def forward(ctx, by: Preconditioner, z: Tensor) -> Tensor:
        ctx.by = by
        return torch.from_numpy(by.forward(z.detach().numpy()))

    @staticmethod
    def backward(ctx, *gradient: Tensor) -> tuple[None, Tensor]:
        return None, torch.from_numpy(ctx.by.backward(gradient[0].numpy()))


@_compiled
def _solve_upper(starts, rows, values, x):
    """Solve L^T y = x (V, n) in place; L has ones on its diagonal, which is not stored."""
    for j in range(len(x) - 1, -1, -1):
        for k in range(starts[j], starts[j + 1]):
            a, i = values[k], rows[k]
            for c in range(x.shape[1]):
                x[j, c] -= a * x[i, c]


@_compiled
def _solve_lower(starts, rows, values, x):
    """Solve L y = x (V, n) in place; L has ones on its diagonal, which is not stored."""
    for j in range(len(x)):
        for k in range(starts[j], starts[j + 1]):
            a, i = values[k], rows[k]
            for c in range(x.shape[1]):
                x[i, c] -= a * x[j, c]
