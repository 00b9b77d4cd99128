"""BLAS and LAPACK on parts of NumPy arrays, in place.

SciPy exports its BLAS for other compiled code. Here BLAS is called through ctypes, which lets other threads run and
copies nothing: a matrix may be a part of the rows of a larger array. Arrays are in C order, in which a Fortran routine
sees the transpose: a lower triangle of BLAS is the upper triangle of the array.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg.cython_blas
import scipy.linalg.cython_lapack

from jeit_solvers.dense import inverse_cholesky


def _routine(module: Any, name: str, num_arguments: int) -> Any:
    """Return a routine of SciPy's BLAS or LAPACK, callable through ctypes with pointers as its `num_arguments`
    arguments."""
    capsule = module.__pyx_capi__[name]
    name_of, pointer_of = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of.restype, pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * num_arguments)
    return signature(pointer_of(capsule, name_of(capsule)))


class _Routines(NamedTuple):
    """BLAS routines and constants for one number type. **Fields**: `triangle`: triangular solve (trsm); `square`:
    symmetric product (syrk); `plus_one`, `minus_one`: arrays that hold the number 1 or -1."""

    triangle: Any
    square: Any
    plus_one: np.ndarray
    minus_one: np.ndarray


def _load_routines(letter: str, dtype: type) -> _Routines:
    blas = scipy.linalg.cython_blas
    routines = _routine(blas, letter + "trsm", 11), _routine(blas, letter + "syrk", 10)
    return _Routines(*routines, np.ones(1, dtype), -np.ones(1, dtype))


_ROUTINES_OF_DTYPE = {np.dtype(float): _load_routines("d", float), np.dtype(complex): _load_routines("z", complex)}
_potrf = _routine(scipy.linalg.cython_lapack, "dpotrf", 5)


@functools.lru_cache(4096)
def _c_integer(value: int) -> Any:
    return ctypes.byref(ctypes.c_int(value))


def _row_stride(matrix: np.ndarray) -> Any:
    """Distance in memory between successive rows of a matrix, counted in numbers."""
    return _c_integer(matrix.strides[0] // matrix.itemsize)


def eliminate(panel: np.ndarray, schur: np.ndarray) -> bool:
    """Eliminate the pivots of a front (a dense matrix of p pivot rows and b border rows), in place. Returns False if
    the pivot block is not positive definite.

    `panel` (p, p + b): on entry the rows [A, B] of the pivots, of which the upper triangle of A and all of B are read;
    on return [Lᵀ, L⁻¹ B] with A = L Lᵀ. `schur` (b, b): Schur complement, from whose upper triangle Bᵀ A⁻¹ B is
    subtracted. Complex matrices are symmetric, and transposes are not conjugated.
    """
    num_pivots, num_border = len(panel), panel.shape[1] - len(panel)
    routines, stride = _ROUTINES_OF_DTYPE[panel.dtype], _row_stride(panel)
    if panel.dtype == complex:
        square: Any = np.triu(panel[:, :num_pivots])
        square += np.triu(square, 1).T
        panel[:, :num_pivots] = inverse_cholesky(square[None])[0] @ square
    else:
        info = ctypes.c_int(0)
        _potrf(b"L", _c_integer(num_pivots), panel.ctypes.data, stride, ctypes.byref(info))
        if info.value:
            return False
    if not np.isfinite(np.diagonal(panel)).all():
        return False
    if num_border:
        border_address, plus_one = panel.ctypes.data + num_pivots * panel.itemsize, routines.plus_one.ctypes.data
        pivot_count, border_count = _c_integer(num_pivots), _c_integer(num_border)
        routines.triangle(
            b"R",
            b"L",
            b"T",
            b"N",
            border_count,
            pivot_count,
            plus_one,
            panel.ctypes.data,
            stride,
            border_address,
            stride,
        )
        minus_one = routines.minus_one.ctypes.data
        routines.square(
            b"L",
            b"N",
            border_count,
            pivot_count,
            minus_one,
            border_address,
            stride,
            plus_one,
            schur.ctypes.data,
            _row_stride(schur),
        )
    return True


def solve_triangle(panel: np.ndarray, vectors: np.ndarray, *, transposed: bool) -> None:
    """Overwrite the `vectors` V (p, k) with L⁻¹ V, or with L⁻ᵀ V if `transposed`. `panel`: [Lᵀ, …], as overwritten by
    `eliminate`."""
    if not vectors.size:
        return
    routines, transposition = _ROUTINES_OF_DTYPE[panel.dtype], b"N" if transposed else b"T"
    pivot_count, num_vectors = _c_integer(len(panel)), _c_integer(vectors.shape[1])
    plus_one, panel_address, stride = routines.plus_one.ctypes.data, panel.ctypes.data, _row_stride(panel)
    routines.triangle(
        b"R",
        b"L",
        transposition,
        b"N",
        num_vectors,
        pivot_count,
        plus_one,
        panel_address,
        stride,
        vectors.ctypes.data,
        _row_stride(vectors),
    )
