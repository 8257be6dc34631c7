"""Coordinates in which a cloth is equally stiff everywhere, kept as a sparse factor of its stiffness."""

from __future__ import annotations

import numba
import numpy as np
import torch
from scipy.sparse import csc_array, sparray, tril
from scipy.sparse.linalg import splu
from torch import Tensor

TYPICAL_OFFSET = 0.01
"""Root-mean-square offset that the coordinates make of white ones of one [m]."""

_AT_ONCE = 256  # columns: bounds memory

_compiled = numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy", boundscheck=False)


class Preconditioner:
    """S (V, V) with S S^T proportional to the inverse of a stiffness matrix (V, V); rms of S z is 1 cm for white z.

    A gradient step of size e in z = S^-1 u moves the offsets u by -e S S^T g: a Newton step of the linear cloth, where
    one in u itself is limited by the stiffest wave of one edge's length (Sobolev preconditioning; Renka and
    Neuberger, SIAM J. Sci. Comput. 16, 1995).

    With K[order][:, order] = L D L^T, S is L^-T D^-1/2 in that order. S is dense and L is not: for 2,355 vertices it
    holds 123,010 numbers. On other devices than the CPU, which are slow at triangles, S is a matrix.
    """

    def __init__(self, stiffness: sparray) -> None:
        """``stiffness`` is symmetric and positive definite, (V, V) [N/m]."""
        factors = splu(
            csc_array(stiffness), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        if not np.array_equal(factors.perm_r, factors.perm_c):
            raise ArithmeticError("the stiffness matrix is not positive definite")
        self._place, self._order = factors.perm_r.astype(np.int64), np.argsort(factors.perm_r)
        self._lower = csc_array(tril(factors.L, -1))
        self._root = np.sqrt(factors.U.diagonal())
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
        ordered = u.detach().cpu().double().numpy()[self._order]
        return torch.from_numpy(self._root[:, None] * (ordered + self._lower.T @ ordered) / self._scale)

    def forward(self, z: np.ndarray) -> np.ndarray:
        """S z."""
        x = np.ascontiguousarray(z * (self._scale / self._root).astype(z.dtype)[:, None])
        _solve_upper(*self._factor(z.dtype), x)
        return x[self._place]

    def backward(self, g: np.ndarray) -> np.ndarray:
        """S^T g."""
        x = g[self._order]
        _solve_lower(*self._factor(g.dtype), x)
        x *= (self._scale / self._root).astype(g.dtype)[:, None]
        return x

    def _factor(self, kind: np.dtype) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._lower.indptr, self._lower.indices, self._lower.data.astype(kind, copy=False)


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
