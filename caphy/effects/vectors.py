"""Vector algebra with the component axis first: a vector field over elements is (3, ..., n).

Planes of one component lie contiguously in memory, which is what makes element-wise torch code fast on a CPU.
"""

from __future__ import annotations

import torch
from torch import Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product (..., n) of vector fields (3, ..., n)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Vector product (3, ..., n) of vector fields (3, ..., n)."""
    return torch.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def norm(a: Tensor, floor: float = 1e-12) -> Tensor:
    """Length (..., n) of a vector field (3, ..., n); its gradient stays finite at zero length."""
    return torch.sqrt(dot(a, a).clamp_min(floor * floor))


def outer(a: Tensor, b: Tensor) -> Tensor:
    """Outer products (k, 3, k, 3, ..., n) of element gradients (k, 3, ..., n)."""
    return a[:, :, None, None] * b


def isotropic(stiffness: Tensor, x: Tensor) -> Tensor:
    """Hessians (1, 3, 1, 3, ..., n) of vertex springs of a stiffness (n,) [N/m] at positions (1, 3, ..., n)."""
    identity = torch.eye(3, dtype=x.dtype, device=x.device)
    return (identity.reshape(1, 3, 1, 3, *(1,) * (x.dim() - 2)) * stiffness).expand(1, 3, 1, *x.shape[1:])


def uniform(vector: Tensor, like: Tensor) -> Tensor:
    """A vector (3,) as a field that broadcasts with vector fields (3, ..., n)."""
    return vector.reshape(3, *(1,) * (like.dim() - 1))
