"""LAPACK and BLAS routines that compiled code can call, by way of scipy's Cython interface."""

from __future__ import annotations

import numba.experimental.function_type  # registers the type of routines  # noqa: F401
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


DPOTRF = Routine("cython_lapack", "dpotrf", 5)
DTRSM = Routine("cython_blas", "dtrsm", 11)
DSYRK = Routine("cython_blas", "dsyrk", 10)
DGEMM = Routine("cython_blas", "dgemm", 13)
