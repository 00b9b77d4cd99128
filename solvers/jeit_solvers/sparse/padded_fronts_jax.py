"""Factorisation and solution of sparse symmetric systems, and products with the inverse, in batches of padded fronts
(`padded_fronts.py`).

The functions run as compiled JAX programs, which can be batched and differentiated; for NumPy arrays they run in NumPy,
without compilation.
"""

from __future__ import annotations

import functools
import operator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Inexact, Int

from jeit_solvers.cores import on_cores, parts_for_cores
from jeit_solvers.dense import inverse_cholesky
from jeit_solvers.engines import differentiable_batches, gather_or_zero, has_values, in_turn, map_one_by_one, namespace
from jeit_solvers.module import Module
from jeit_solvers.sparse.index_store import IndexLayout
from jeit_solvers.sparse.padded_fronts import FactorisationPlan, Stage

# Minimum number of entries in the fronts of a stage for which threads are used.
_MIN_PARALLEL_ENTRIES = 200_000
# Number of entries in the fronts that are updated together.
_NUM_ENTRIES_UPDATED_AT_ONCE = 100_000


class Factor(Module):
    """A factorised matrix A = L L^T: two arrays for every stage of its plan.

    **Fields**: `inverses`: (batch, pivots, pivots) inverses of the diagonal blocks of L; `lowers`: (batch, border,
    pivots) blocks of L below the diagonal blocks. Solving therefore needs only matrix products. For a complex symmetric
    A, transposes are not conjugated.

    **Example:**

    ```python
    factor = factorise(plan, jnp.asarray(values))
    factor.positive_definite
    ```
    """

    inverses: tuple[Inexact[Array, "batch pivots pivots"], ...]
    lowers: tuple[Inexact[Array, "batch border pivots"], ...]

    @property
    def positive_definite(self) -> Bool[Array, ""]:
        """Whether the matrix is positive definite (for a complex matrix: whether every pivot has a positive real
        part)."""
        diagonals = [jnp.diagonal(inverse, axis1=-2, axis2=-1) for inverse in self.inverses]
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(diagonal), axis=(-2, -1)) for diagonal in diagonals]), axis=0)

    def require_positive_definite(self) -> None:
        """Raise `ValueError` if the matrix is not positive definite. The check is omitted inside `jax.jit`, `jax.grad`
        or `jax.vmap`, where values are not known yet."""
        is_positive_definite = self.positive_definite
        if has_values(is_positive_definite) and not is_positive_definite.all():
            raise ValueError(
                "factorise: the matrix is not positive definite, so it has no Cholesky factor. In a finite-element "
                "system the usual reasons are: a coefficient that is zero, negative or NaN somewhere; no boundary "
                "condition that fixes the solution's constant part, which leaves the matrix singular; or a part of the "
                "mesh that is not connected to the rest."
            )


def factorise(plan: FactorisationPlan, values: Inexact[Array, " nnz"]) -> Factor:
    """Factorise a sparse symmetric matrix.

    Real values must form a positive definite matrix. Complex values, for example from admittivities, form a complex
    *symmetric* matrix, whose real part must be positive definite. Otherwise the factor is NaN and `positive_definite`
    is false. Raises `ValueError` for values of a wrong shape.

    **Arguments:**

    - `plan`: from `analyse`.
    - `values` (nnz,): entries of the matrix, in the order of the pattern from which the plan was computed.

    **Example:**

    ```python
    factor = factorise(plan, jnp.asarray(values))
    solve(plan, factor, loads)
    ```
    """
    if values.shape != (plan.num_entries,):
        raise ValueError(
            f"factorise: `values` must have shape {(plan.num_entries,)}, the entries of the plan's pattern; "
            f"got {values.shape}. Use jax.vmap for a batch of matrices."
        )
    if isinstance(values, np.ndarray):
        return _factorise_in_numpy(plan.layout, plan.indices, values)
    compute_factor = in_turn(partial(_compiled_factorise, plan.layout))
    return compute_factor(plan.indices, values)


def _factorise_stages(layout: IndexLayout, indices: Int[Array, " total"], values: Inexact[Array, " nnz"]) -> Factor:
    stages, _ = layout.content
    dtype = values.dtype
    extended_values = jnp.concatenate([values, jnp.ones(1, dtype)])
    inverses, lower_blocks, schur_complements = [], [], []
    for stage in stages:
        pivots, border = stage.pivots, stage.border
        panel = stage.entries.apply(indices, extended_values)
        schur_corner = jnp.zeros(stage.batch * border * border, dtype)
        for link in stage.links:
            child_schur = schur_complements[link.source].reshape(-1)
            panel += link.panel.apply(indices, child_schur)
            schur_corner += link.corner.apply(indices, child_schur)
        panel = panel.reshape(stage.batch, pivots + border, pivots)
        inverse = inverse_cholesky(panel[:, :pivots])
        lower_block = panel[:, pivots:] @ _transpose(inverse)
        inverses.append(inverse)
        lower_blocks.append(lower_block)
        schur_corner = schur_corner.reshape(stage.batch, border, border)
        schur_corner -= lower_block @ _transpose(lower_block)
        schur_complements.append(schur_corner)
    return Factor(tuple(inverses), tuple(lower_blocks))


# Compiled separately, so that a second program with the same plan does not trace the factorisation again.
_compiled_factorise = jax.jit(_factorise_stages, static_argnums=0)


def _factorise_in_numpy(
    layout: IndexLayout, indices: Int[Array, " total"], values: Inexact[np.ndarray, " nnz"]
) -> Factor:
    """Factorise as `_factorise_stages`, but in NumPy and in place, with the fronts of a stage distributed over the
    cores."""
    stages, _ = layout.content
    extended_values = np.concatenate([values, np.ones(1, values.dtype)])
    inverses, lowers, schur_complements = [], [], []
    for stage in stages:
        num_fronts, pivots, border = stage.batch, stage.pivots, stage.border
        panel = np.zeros((num_fronts, pivots + border, pivots), values.dtype)
        corner = np.zeros((num_fronts, border, border), values.dtype)
        inverse, lower_blocks = (
            np.empty_like(panel, shape=(num_fronts, pivots, pivots)),
            np.empty_like(panel[:, pivots:]),
        )
        eliminate_slice = partial(
            _eliminate_fronts, stage, indices, extended_values, schur_complements, panel, corner, inverse, lower_blocks
        )
        is_large = num_fronts * (pivots + border) ** 2 > _MIN_PARALLEL_ENTRIES
        on_cores(eliminate_slice, parts_for_cores(num_fronts) if is_large else [slice(0, num_fronts)])
        inverses.append(inverse)
        lowers.append(lower_blocks)
        schur_complements.append(corner)
    return Factor(tuple(inverses), tuple(lowers))


def _eliminate_fronts(
    stage: Stage, indices, extended_values, schur_complements, panel, corner, inverse, lower_blocks, front_slice: slice
) -> None:
    """Assemble and eliminate the fronts `front_slice` of a stage, in place. `schur_complements`: Schur complements of
    all earlier stages."""

    def add_contributions(padded_sum, contributions, target):
        target_size = target[0].size
        padded_sum.add_range(
            indices, contributions, target.reshape(-1), front_slice.start * target_size, front_slice.stop * target_size
        )

    add_contributions(stage.entries, extended_values, panel)
    for link in stage.links:
        child_schur = schur_complements[link.source].reshape(-1)
        add_contributions(link.panel, child_schur, panel)
        add_contributions(link.corner, child_schur, corner)
    inverse[front_slice] = inverse_cholesky(panel[front_slice, : stage.pivots])
    np.matmul(panel[front_slice, stage.pivots :], _transpose(inverse[front_slice]), out=lower_blocks[front_slice])
    num_fronts_at_once = max(1, _NUM_ENTRIES_UPDATED_AT_ONCE // max(stage.border**2, 1))
    for first_front in range(front_slice.start, front_slice.stop, num_fronts_at_once):
        update_slice = slice(first_front, min(first_front + num_fronts_at_once, front_slice.stop))
        corner[update_slice] -= lower_blocks[update_slice] @ _transpose(lower_blocks[update_slice])


def solve(plan: FactorisationPlan, factor: Factor, right_hand_sides: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
    """Solution x of A x = b for a factorised matrix A.

    **Arguments:**

    - `plan`: from `analyse`.
    - `factor`: from `factorise`.
    - `right_hand_sides` (n,) or (n, k): b, one or several vectors.

    Raises `ValueError` for wrong shapes.

    **Example:**

    ```python
    solution = solve(plan, factor, loads)
    ```
    """
    vectors = _check_columns(plan, right_hand_sides, "solve")
    if isinstance(vectors, np.ndarray):
        return _solve_stages(plan.layout, plan.indices, factor, vectors).reshape(right_hand_sides.shape)
    compute_solution = differentiable_batches(partial(_compiled_solve, plan.layout), _solve_batch)
    return compute_solution(plan.indices, factor, vectors).reshape(right_hand_sides.shape)


def _solve_stages(
    layout: IndexLayout, indices: Int[Array, " total"], factor: Factor, vectors: Inexact[Array, "n k"]
) -> Inexact[Array, "n k"]:
    stages, solution_indices = layout.content
    reduced_vectors = _forward_stages(layout, indices, factor, vectors)
    return _backward_stages(stages, indices, factor, reduced_vectors)[solution_indices.read(indices)]


_compiled_solve = jax.jit(_solve_stages, static_argnums=0)


def _solve_batch(batchable, unbatched, axis_size, batched, indices, factor, vectors):
    """Batching rule of `solve`: a batch of right-hand sides for one factor is solved as additional columns, and a batch
    of factors one by one."""
    if any(jax.tree.leaves(batched[:2])):
        return map_one_by_one(batchable, unbatched, axis_size, batched, indices, factor, vectors)
    matrix_size, num_columns = vectors.shape[1:]
    joined_columns = jnp.moveaxis(vectors, 0, 1).reshape(matrix_size, axis_size * num_columns)
    return jnp.moveaxis(batchable(indices, factor, joined_columns).reshape(matrix_size, axis_size, num_columns), 1, 0)


def half_solve(
    plan: FactorisationPlan, factor: Factor, right_hand_sides: Inexact[Array, "n k"]
) -> Inexact[Array, "rows k"]:
    """Forward half of a solve: Y = L^-1 P b, where P sorts rows into the order of elimination, so that Y^T Y = b^T A^-1
    b. Padding adds rows of zeros.

    This function takes half the time of `solve`, and is sufficient for quadratic forms of the inverse.

    **Arguments:**

    - `plan`, `factor`, `right_hand_sides` (n, k): as for `solve`.

    Raises `ValueError` for wrong shapes.

    **Example:**

    ```python
    half = half_solve(plan, factor, loads)
    half.T @ half
    ```
    """
    vectors = _check_columns(plan, right_hand_sides, "half_solve")
    forward_function = _forward_stages if isinstance(vectors, np.ndarray) else _compiled_forward
    reduced_vectors = forward_function(plan.layout, plan.indices, factor, vectors)
    return namespace(vectors).concatenate(
        [stage_rows.reshape(-1, stage_rows.shape[-1]) for stage_rows in reduced_vectors]
    )


def quadratic_form(
    plan: FactorisationPlan, factor: Factor, right_hand_sides: Inexact[Array, "n k"]
) -> Inexact[Array, "k k"]:
    """Symmetric quadratic form b^T A^-1 b (complex values are not conjugated), computed by the forward half of a solve.

    **Arguments:**

    - `plan`, `factor`, `right_hand_sides` (n, k): as for `solve`.

    **Example:**

    ```python
    energy = quadratic_form(plan, factor, loads)
    ```
    """
    half_solution = half_solve(plan, factor, right_hand_sides)
    return half_solution.T @ half_solution


def inverse_root(plan: FactorisationPlan, factor: Factor, rows: Inexact[Array, "rows k"]) -> Inexact[Array, "n k"]:
    """Product of P^T L^-T, a root of A^-1, with vectors whose rows are in the order of `half_solve`. Standard normal
    vectors become vectors with covariance A^-1.

    **Arguments:**

    - `plan`: from `analyse`.
    - `factor`: from `factorise`.
    - `rows` (rows, k): the vectors, with `plan.num_pivots` rows.

    Raises `ValueError` for a different number of rows.

    **Example:**

    ```python
    normal = jax.random.normal(jax.random.key(0), (plan.num_pivots, 10))
    samples = inverse_root(plan, factor, normal)
    ```
    """
    if rows.ndim != 2 or rows.shape[0] != plan.num_pivots:
        raise ValueError(f"inverse_root: rows must have shape ({plan.num_pivots}, k); got {rows.shape}.")
    if isinstance(rows, np.ndarray):
        return _backward_solve(plan.layout, plan.indices, factor, rows)
    return _compiled_backward_solve(plan.layout, plan.indices, factor, rows)


def inverse_entries(plan: FactorisationPlan, factor: Factor) -> Inexact[Array, " nnz"]:
    """Entries (nnz,) of A^-1 at the positions of the pattern of A, in the order of the pattern, diagonal first.

    The entries are computed from the factor by a recursion from the root of the elimination tree down, in about the
    time of a factorisation. Computing all entries of A^-1 would take as many solves as there are rows. Takahashi, Fagan
    and Chin, Proc. 8th PICA Conf. (1973) 63-69; Erisman and Tinney, Commun. ACM 18 (1975) 177-179.

    **Arguments:**

    - `plan`: from `analyse`.
    - `factor`: from `factorise`.

    **Example:**

    ```python
    variances = inverse_entries(plan, factor)[:50]
    ```
    """
    if isinstance(factor.inverses[0], np.ndarray):
        return _inverse_entries(plan.layout, plan.num_entries, plan.indices, factor)
    return _compiled_inverse_entries(plan.layout, plan.num_entries, plan.indices, factor)


def _inverse_entries(
    layout: IndexLayout, num_entries: int, indices: Int[Array, " total"], factor: Factor
) -> Inexact[Array, " nnz"]:
    """Entries of the inverse Z = A^-1, computed front by front from the root down. Let A = L L^T, and let p be the
    pivots and b the border rows of a front. The block Z_bb is read from the parent front; the other blocks are Z_bp =
    -Z_bb K and Z_pp = L_pp^-T L_pp^-1 + K^T Z_bb K, where K = L_bp L_pp^-1."""
    stages, _ = layout.content
    xp, dtype = namespace(factor), factor.inverses[0].dtype
    entries = xp.zeros(num_entries + 2, dtype)  # one extra for padded pivots, and one for positions outside the pattern
    first_child = {stage.parent: k for k, stage in reversed(list(enumerate(stages))) if stage.border}
    front_blocks: dict[int, Inexact[Array, "batch height height"]] = {}
    for k in reversed(range(len(stages))):
        stage, inverse = stages[k], factor.inverses[k]
        pivot_block = _transpose(inverse) @ inverse
        front_block = pivot_block
        if stage.border:
            parent_blocks = front_blocks[stage.parent]
            border_block = _border_block(parent_blocks, stage.above.read(indices))
            elimination_weights = factor.lowers[k] @ inverse
            border_columns = border_block @ elimination_weights
            pivot_block = pivot_block + _transpose(elimination_weights) @ border_columns
            panel = xp.concatenate([pivot_block, -border_columns], axis=1)
            front_block = xp.concatenate(
                [panel, xp.concatenate([-_transpose(border_columns), border_block], axis=1)], axis=2
            )
        entries = stage.entries.replace_by_sums(indices, front_block[:, :, : stage.pivots].reshape(-1), entries)
        if k in first_child:
            front_blocks[k] = front_block
        if stage.border and first_child[stage.parent] == k:
            del front_blocks[stage.parent]  # no front further down needs the entries of the parent
    return entries[:num_entries]


def _border_block(parent_rows: Inexact[Array, "parents height height"], rows: Int[Array, "batch border"]):
    """Entries of the inverse between the border rows of child fronts, read from the parents' fronts; zero for
    padding."""
    height = parent_rows.shape[-1]
    front_slot, index_in_front = rows // height, rows % height
    # Padding gets the index after the last entry.
    flat_indices = (front_slot[:, :, None] * height + index_in_front[:, :, None]) * height + index_in_front[:, None, :]
    is_border_row = rows < parent_rows.shape[0] * height
    flat_indices = namespace(parent_rows).where(
        is_border_row[:, :, None] & is_border_row[:, None, :], flat_indices, parent_rows.size
    )
    return gather_or_zero(parent_rows.reshape(-1), flat_indices)


_compiled_inverse_entries = jax.jit(_inverse_entries, static_argnums=(0, 1))


def _backward_solve(
    layout: IndexLayout, indices: Int[Array, " total"], factor: Factor, rows: Inexact[Array, "rows k"]
) -> Inexact[Array, "n k"]:
    stages, solution_indices = layout.content
    stage_ends = np.cumsum([stage.batch * stage.pivots for stage in stages])
    stage_rows = namespace(rows).split(rows, stage_ends[:-1])
    stage_rows = [
        rows_of_stage.reshape(stage.batch, stage.pivots, -1)
        for rows_of_stage, stage in zip(stage_rows, stages, strict=True)
    ]
    return _backward_stages(stages, indices, factor, stage_rows)[solution_indices.read(indices)]


_compiled_backward_solve = jax.jit(_backward_solve, static_argnums=0)


def _transpose(matrices: Inexact[Array, "batch a b"]) -> Inexact[Array, "batch b a"]:
    return namespace(matrices).swapaxes(matrices, -1, -2)


def _check_columns(
    plan: FactorisationPlan, right_hand_sides: Inexact[Array, "n *k"], function_name: str
) -> Inexact[Array, "n k"]:
    if right_hand_sides.ndim not in (1, 2) or right_hand_sides.shape[0] != plan.size:
        raise ValueError(
            f"{function_name}: right-hand sides must have shape (n,) or (n, k) with n = {plan.size}; "
            f"got {right_hand_sides.shape}."
        )
    return right_hand_sides.reshape(plan.size, -1)


def _forward_stages(
    layout: IndexLayout, indices: Int[Array, " total"], factor: Factor, vectors: Inexact[Array, "n k"]
) -> list[Inexact[Array, "batch pivots k"]]:
    """Product of L^-1 with the vectors (n, k), stage by stage. The pivot rows of a front receive the updates from its
    children."""
    stages, _ = layout.content
    num_columns = vectors.shape[1]
    reduced_vectors, stage_updates = [], []
    for stage, inverse, lower_block in zip(stages, factor.inverses, factor.lowers, strict=True):
        pivot_rows = gather_or_zero(vectors, stage.right_hand_side.read(indices))
        child_updates = [
            link.rows.apply(indices, stage_updates[link.source].reshape(-1, num_columns)) for link in stage.links
        ]
        child_updates = [child_update.reshape(stage.batch, -1, num_columns) for child_update in child_updates]
        pivot_rows = sum((child_update[:, : stage.pivots] for child_update in child_updates), pivot_rows)
        zero_scalar = namespace(vectors).zeros((), vectors.dtype)
        border_update = functools.reduce(
            operator.add, [child_update[:, stage.pivots :] for child_update in child_updates] or [zero_scalar]
        )
        reduced_vectors.append(inverse @ pivot_rows)
        stage_updates.append(border_update - lower_block @ reduced_vectors[-1])
    return reduced_vectors


_compiled_forward = jax.jit(_forward_stages, static_argnums=0)


def _backward_stages(
    stages: tuple[Stage, ...],
    indices: Int[Array, " total"],
    factor: Factor,
    reduced_vectors: list[Inexact[Array, "batch pivots k"]],
) -> Inexact[Array, "rows k"]:
    """Product of L^-T with the vectors `reduced_vectors`, computed from the root down; returns the rows at the pivots
    of all stages. The solution at the border of a front is read from the parent front."""
    num_columns, xp = reduced_vectors[0].shape[-1], namespace(reduced_vectors)
    fronts: dict[int, Inexact[Array, "rows k"]] = {}
    pivot_values = []
    for k in reversed(range(len(stages))):
        stage, pivot_residual = stages[k], reduced_vectors[k]
        border_values = xp.zeros((stage.batch, 0, num_columns), pivot_residual.dtype)
        if stage.border:
            border_values = gather_or_zero(fronts[stage.parent], stage.above.read(indices))
            pivot_residual = pivot_residual - _transpose(factor.lowers[k]) @ border_values
        pivot_solution = _transpose(factor.inverses[k]) @ pivot_residual
        pivot_values.append(pivot_solution.reshape(-1, num_columns))
        fronts[k] = xp.concatenate([pivot_solution, border_values], axis=1).reshape(-1, num_columns)
    return xp.concatenate(pivot_values[::-1])
