"""BLAS and LAPACK on parts of NumPy arrays, in place.

SciPy exports its BLAS for other compiled code; here it is called through ctypes, which lets other threads run, and
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


def _routine(module: Any, name: str, arguments: int) -> Any:
    """A routine of SciPy's BLAS or LAPACK; all its arguments are pointers."""
    capsule = module.__pyx_capi__[name]
    name_of, pointer_of = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of.restype, pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)
    return signature(pointer_of(capsule, name_of(capsule)))


class _Kind(NamedTuple):
    """Routines and constants of a number type; `one`, `minus_one`: arrays of a single number."""

    triangle: Any
    square: Any
    one: np.ndarray
    minus_one: np.ndarray


def _kind(letter: str, dtype: type) -> _Kind:
    blas = scipy.linalg.cython_blas
    routines = _routine(blas, letter + "trsm", 11), _routine(blas, letter + "syrk", 10)
    return _Kind(*routines, np.ones(1, dtype), -np.ones(1, dtype))


_KINDS = {np.dtype(float): _kind("d", float), np.dtype(complex): _kind("z", complex)}
_potrf = _routine(scipy.linalg.cython_lapack, "dpotrf", 5)


@functools.lru_cache(4096)
def _length(number: int) -> Any:
    return ctypes.byref(ctypes.c_int(number))


def _stride(matrix: np.ndarray) -> Any:
    """Distance of the rows of a matrix, in numbers."""
    return _length(matrix.strides[0] // matrix.itemsize)


def eliminate(panel: np.ndarray, schur: np.ndarray) -> bool:
    """Eliminate the pivots of a front, in place; false if it is not positive definite.

    `panel` (p, p + b): on entry the rows [A, B] of the pivots, of which the upper triangle of A and all of B are read,
    on return [Lᵀ, L⁻¹ B] with A = L Lᵀ; `schur` (b, b): on return less Bᵀ A⁻¹ B, in its upper triangle. Complex
    matrices are symmetric, and nothing is conjugated.
    """
    pivots, border = len(panel), panel.shape[1] - len(panel)
    kind, stride = _KINDS[panel.dtype], _stride(panel)
    if panel.dtype == complex:
        square: Any = np.triu(panel[:, :pivots])
        square += np.triu(square, 1).T
        panel[:, :pivots] = inverse_cholesky(square[None])[0] @ square
    else:
        info = ctypes.c_int(0)
        _potrf(b"L", _length(pivots), panel.ctypes.data, stride, ctypes.byref(info))
        if info.value:
            return False
    if not np.isfinite(np.diagonal(panel)).all():
        return False
    if border:
        right, one = panel.ctypes.data + pivots * panel.itemsize, kind.one.ctypes.data
        count, wide = _length(pivots), _length(border)
        kind.triangle(b"R", b"L", b"T", b"N", wide, count, one, panel.ctypes.data, stride, right, stride)
        minus = kind.minus_one.ctypes.data
        kind.square(b"L", b"N", wide, count, minus, right, stride, one, schur.ctypes.data, _stride(schur))
    return True


def solve_triangle(panel: np.ndarray, vectors: np.ndarray, *, transposed: bool) -> None:
    """Overwrite vectors (p, k) with L⁻¹ vectors, or L⁻ᵀ vectors; `panel` from `eliminate`, [Lᵀ, …]."""
    if not vectors.size:
        return
    kind, which = _KINDS[panel.dtype], b"N" if transposed else b"T"
    count, number = _length(len(panel)), _length(vectors.shape[1])
    one, triangle, stride = kind.one.ctypes.data, panel.ctypes.data, _stride(panel)
    kind.triangle(b"R", b"L", which, b"N", number, count, one, triangle, stride, vectors.ctypes.data, _stride(vectors))
