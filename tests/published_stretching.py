"""The stretching tables as published, plainly, to hold against the energy that is made of them."""

from __future__ import annotations

import numpy as np

from caphy.material.fabrics import LOADED_TWICE, STRETCH_SAMPLED


def stretching_stiffness(table: np.ndarray, strain: np.ndarray) -> np.ndarray:
    """Stiffness (..., 4) [N/m] of the tensor C_uuuu, C_uuvv, C_vvvv, C_uv at Green strains (..., 3): uu, vv, uv.

    As published and as ARCSim evaluates it: linear in the largest principal stretch between the row near zero strain
    and the rows at 16.7 %, linear in that stretch's direction between those, negative entries taken as zero, doubled.
    The shear strain enters by its size: the fabric is orthotropic. In equal biaxial stretch the direction is the weft.
    """
    uu, vv, uv = np.moveaxis(np.asarray(strain, dtype=float), -1, 0)
    uv = np.abs(uv)
    mean, half = 0.5 * (uu + vv), 0.5 * (uu - vv)
    radius = np.hypot(half, uv)
    stretch = np.sqrt(np.maximum(1 + 2 * (mean + radius), 0))
    angle = 0.5 * np.arctan2(uv, half)
    along = np.clip(angle / np.pi * 8, 0, 4 - 1e-6)
    share = np.clip((stretch - 1) / STRETCH_SAMPLED, 0, 1 - 1e-6)[..., None]
    node = along.astype(int)
    between = (along - node)[..., None]
    sampled = (1 - between) * table[1 + node] + between * table[2 + node]
    return LOADED_TWICE * np.maximum((1 - share) * table[0] + share * sampled, 0)
