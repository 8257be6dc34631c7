"""LAPACK and BLAS routines that compiled code can call, by way of scipy's Cython interface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import get_cython_function_address, intrinsic


def _call(typingctx, routine, arguments):
    """Call a ``routine`` that returns nothing with a tuple of ``arguments``, addresses, as Fortran wants them.

    Routines are passed to compiled functions as numbers, their addresses. Referring to one would keep the compiled
    function from being cached, since addresses differ between processes; and telling the type of one that is passed
    as an object takes longer than the work on a small front.
    """

    def code(context, builder, signature, values):
        address, packed = values
        each = cgutils.unpack_tuple(builder, packed)
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in each])
        builder.call(builder.inttoptr(address, kind.as_pointer()), each)
        return context.get_dummy_value()

    return types.void(routine, arguments), code


call: Callable[..., None] = intrinsic(_call)
"""To be called by compiled code."""


def _precisions(module: str, name: str) -> dict[type, np.uint64]:
    return {
        dtype: np.uint64(get_cython_function_address(f"scipy.linalg.{module}", letter + name))
        for dtype, letter in ((np.float32, "s"), (np.float64, "d"))
    }


POTRF = _precisions("cython_lapack", "potrf")
TRSM = _precisions("cython_blas", "trsm")
TRSV = _precisions("cython_blas", "trsv")
SYRK = _precisions("cython_blas", "syrk")
GEMV = _precisions("cython_blas", "gemv")
GEMM = _precisions("cython_blas", "gemm")
