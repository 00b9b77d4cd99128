"""Sparse symmetric matrices as lineax operators, and base classes of their solvers."""

from __future__ import annotations

import abc
import hashlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import numpy as np
from jaxtyping import Array, Inexact

from jeit_solvers.engines import call_numpy, has_values, host, on_host
from jeit_solvers.sparse.pattern import SparsityPattern


class SparseSymmetric(lineax.AbstractLinearOperator):
    """A symmetric (n, n) matrix with the given values (nnz,) in a sparsity pattern, as a lineax operator.

    Real matrices are assumed to be positive definite, as the solvers of this package require. Complex matrices are
    symmetric, not Hermitian. Products and solutions are differentiable with respect to the values. Raises `ValueError`
    if the shape of the values does not match the pattern, and for values that are not floating point.

    **Arguments:**

    - `values` (nnz,): entries of the matrix in the order of the pattern, diagonal first.
    - `pattern`: sparsity pattern.

    **Example:**

    ```python
    operator = SparseSymmetric(jnp.asarray(values), pattern)
    operator.mv(jnp.ones(50))
    ```
    """

    values: Inexact[Array, " nnz"]
    pattern: SparsityPattern

    def __init__(self, values: Inexact[Array, " nnz"], pattern: SparsityPattern):
        values = values if isinstance(values, np.ndarray) else jnp.asarray(values)
        if values.shape != (pattern.num_entries,):
            raise ValueError(
                f"SparseSymmetric: `values` must have shape {(pattern.num_entries,)}, one for each entry of the "
                f"pattern; got {values.shape}. Make them with `pattern.assemble`; use jax.vmap for batches."
            )
        if not jnp.issubdtype(values.dtype, jnp.inexact):
            raise ValueError(f"SparseSymmetric: `values` must be floating point; got dtype {values.dtype}.")
        self.values = values
        self.pattern = pattern

    def mv(self, vector: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        """Product of the matrix with a vector (n,)."""
        return self.pattern.multiply(self.values, vector)

    def as_matrix(self) -> Inexact[Array, "n n"]:
        """The matrix as a dense array (n, n)."""
        return self.pattern.to_dense(self.values)

    def transpose(self) -> "SparseSymmetric":
        """The matrix itself: it is symmetric."""
        return self

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """Shape and data type of a vector that the matrix can be multiplied with."""
        return jax.ShapeDtypeStruct((self.pattern.size,), self.values.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """Shape and data type of a product; equal to the shape and data type of the vector, because the matrix is
        square."""
        return self.in_structure()


@lineax.linearise.register(SparseSymmetric)
@lineax.materialise.register(SparseSymmetric)
def _(operator: SparseSymmetric) -> SparseSymmetric:
    return operator


@lineax.conj.register(SparseSymmetric)
def _(operator: SparseSymmetric) -> SparseSymmetric:
    return eqx.tree_at(lambda op: op.values, operator, operator.values.conj())


@lineax.diagonal.register(SparseSymmetric)
def _(operator: SparseSymmetric) -> Inexact[Array, " n"]:
    return operator.pattern.diagonal(operator.values)


@lineax.tridiagonal.register(SparseSymmetric)
def _(operator: SparseSymmetric):
    matrix = operator.as_matrix()
    return jnp.diagonal(matrix), jnp.diagonal(matrix, -1), jnp.diagonal(matrix, 1)


@lineax.is_symmetric.register(SparseSymmetric)
def _(operator: SparseSymmetric) -> bool:
    return True


@lineax.is_positive_semidefinite.register(SparseSymmetric)
def _(operator: SparseSymmetric) -> bool:
    return not jnp.issubdtype(operator.values.dtype, jnp.complexfloating)


@lineax.is_negative_semidefinite.register(SparseSymmetric)
@lineax.is_diagonal.register(SparseSymmetric)
@lineax.is_tridiagonal.register(SparseSymmetric)
@lineax.has_unit_diagonal.register(SparseSymmetric)
@lineax.is_lower_triangular.register(SparseSymmetric)
@lineax.is_upper_triangular.register(SparseSymmetric)
def _(operator: SparseSymmetric) -> bool:
    return False


def require_sparse_symmetric(operator: lineax.AbstractLinearOperator, solver: str) -> SparseSymmetric:
    """Return the operator if it is a `SparseSymmetric`. Raises `ValueError` otherwise, with an explanation of how to
    make a `SparseSymmetric`."""
    if isinstance(operator, lineax.TaggedLinearOperator):
        operator = operator.operator
    if not isinstance(operator, SparseSymmetric):
        raise ValueError(
            f"{solver} solves systems with `SparseSymmetric` operators only; got a {type(operator).__name__}. Make one "
            "with `pattern, values = SparsityPattern.from_matrix(matrix)` and `SparseSymmetric(values, pattern)`."
        )
    return operator


class MatrixSolver(lineax.AbstractLinearSolver[SparseSymmetric]):
    """Base of linear solvers whose state is the matrix itself."""

    def init(self, operator: lineax.AbstractLinearOperator, options: dict[str, Any]) -> SparseSymmetric:
        """Return the matrix itself. Raises `ValueError` for an operator that is not a `SparseSymmetric`."""
        del options
        return require_sparse_symmetric(operator, type(self).__name__)

    def transpose(self, state: SparseSymmetric, options: dict[str, Any]) -> tuple[SparseSymmetric, dict[str, Any]]:
        """Return the matrix, which equals its transpose."""
        return state, options

    def conj(self, state: SparseSymmetric, options: dict[str, Any]) -> tuple[SparseSymmetric, dict[str, Any]]:
        """Return the conjugate matrix."""
        return SparseSymmetric(state.values.conj(), state.pattern), options

    def assume_full_rank(self) -> bool:
        """Always true, because a positive definite matrix has full rank."""
        return True


class NumpySolver(MatrixSolver):
    """Base of solvers for several right-hand sides at once that run in NumPy; compiled programs call them.

    A solver is a subclass with `solve_in_numpy`.

    **Example:**

    ```python
    isinstance(Multigrid(), NumpySolver)  # with pyamg
    ```
    """

    @abc.abstractmethod
    def solve_in_numpy(self, pattern: SparsityPattern, values: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Solutions (n, k) for right-hand sides `columns` (n, k); NaN where the solver fails."""

    def solve_columns(self, state: SparseSymmetric, columns: Inexact[Array, "n k"]) -> Inexact[Array, "n k"]:
        """Solutions (n, k) for k right-hand sides `columns`."""
        pattern, result_dtype = state.pattern, jnp.result_type(state.values, columns)
        result_shape = jax.ShapeDtypeStruct(columns.shape, result_dtype)

        def solve_with_pattern(pattern: SparsityPattern, matrix_values: Any, side_columns: Any) -> np.ndarray:
            column_solutions = self.solve_in_numpy(pattern, np.asarray(matrix_values), np.asarray(side_columns))
            return column_solutions.astype(result_dtype, copy=False)

        if has_values(pattern):  # constants, not stored in the compiled program because they are large
            host_pattern = on_host(pattern)
            if has_values(state, columns):
                return host.asarray(solve_with_pattern(host_pattern, state.values, columns))
            return call_numpy(
                lambda matrix_values, side_columns: solve_with_pattern(host_pattern, matrix_values, side_columns),
                result_shape,
                state.values,
                columns,
            )

        def solve_flattened(indices: np.ndarray, matrix_values: np.ndarray, side_columns: np.ndarray) -> np.ndarray:
            traced_pattern = SparsityPattern(indices, pattern.layout, pattern.size)  # pyright: ignore[reportArgumentType]
            return solve_with_pattern(traced_pattern, matrix_values, side_columns)

        return call_numpy(solve_flattened, result_shape, pattern.indices, state.values, columns)

    def compute(
        self, state: SparseSymmetric, vector: Inexact[Array, " n"], options: dict[str, Any]
    ) -> tuple[Inexact[Array, " n"], lineax.RESULTS, dict[str, Any]]:
        """Solve for one right-hand side. A failure yields NaN, which `lineax.linear_solve` reports as singular."""
        del options
        return self.solve_columns(state, vector[:, None])[:, 0], lineax.RESULTS.successful, {}


def pattern_key(pattern: SparsityPattern) -> bytes:
    """Key of a sparsity pattern for `LastMatrixCache`."""
    return hashlib.blake2b(np.ascontiguousarray(pattern.indices).tobytes(), digest_size=16).digest()


class LastMatrixCache:
    """Cache of one result, such as a factor, for the matrix that was used last, because derivatives solve with the same
    matrix again."""

    def __init__(self) -> None:
        self._last_result: tuple[bytes, Any] | None = None

    def get_or_compute(
        self, key: bytes, values: np.ndarray, compute: Callable[[], Any], *, keeps_result: bool = True
    ) -> Any:
        """Return the result of `compute` for the matrix with the given values (nnz,), from the cache if the last call
        was for the same matrix. `key` distinguishes sparsity patterns; with `keeps_result` False the result is not
        cached."""
        values_digest = hashlib.blake2b(np.ascontiguousarray(values).tobytes(), digest_size=16).digest()
        key += values.dtype.str.encode() + values_digest
        last_result = self._last_result  # another thread may replace it meanwhile
        if last_result is not None and last_result[0] == key:
            return last_result[1]
        self._last_result = last_result = None  # frees the memory for the next result
        new_result = compute()
        self._last_result = (key, new_result) if keeps_result else None
        return new_result
