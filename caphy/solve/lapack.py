"""LAPACK and BLAS routines that compiled code can call, by way of scipy's Cython interface."""

from __future__ import annotations

import numba.experimental.function_type  # registers the type of routines  # noqa: F401
import numpy as np
from numba import types
from numba.extending import get_cython_function_address


class Routine(types.WrapperAddressProtocol):
    """A routine, to be passed to a compiled function; its arguments are addresses, as Fortran wants them.

    Passing it, instead of referring to it, lets the compiled function be cached: addresses differ between processes.
    """

    def __init__(self, module: str, name: str, arguments: int) -> None:
        self._address = get_cython_function_address(f"scipy.linalg.{module}", name)
        self._signature = types.void(*[types.uintp] * arguments)

    def __wrapper_address__(self) -> int:
        return self._address

    def signature(self):
        """The type of the routine."""
        return self._signature


def _precisions(module: str, name: str, arguments: int) -> dict[type, Routine]:
    return {
        np.float32: Routine(module, "s" + name, arguments),
        np.float64: Routine(module, "d" + name, arguments),
    }


POTRF = _precisions("cython_lapack", "potrf", 5)
TRSM = _precisions("cython_blas", "trsm", 11)
SYRK = _precisions("cython_blas", "syrk", 10)
GEMM = _precisions("cython_blas", "gemm", 13)
