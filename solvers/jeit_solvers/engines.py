"""Two engines for the same formula, NumPy and JAX, and batching rules for `jax.vmap`.

JAX traces and compiles a program before it runs, which takes seconds; NumPy runs at once, and is as fast on large
arrays. Therefore functions run in NumPy if the values of all arrays are known, and in a compiled program if arrays are
traced, batched or differentiated. A formula works in NumPy and in JAX if it uses only the functions below and the
functions common to `numpy` and `jax.numpy`.

Under `jax.vmap` on a CPU, matrices are factorised one after the other, and the systems are solved for all right-hand
sides at once. If all matrices of a batch were factorised together, the whole batch would move through memory at every
stage. A factorisation would take more than twice as long as that of a single matrix, which stays in the cache.
Accelerators process the whole batch at once.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, Inexact, Int, Shaped


def in_turn(function: Callable[..., Any]) -> Callable[..., Any]:
    """Make `jax.vmap` on a CPU call a function of arrays for the elements of the batch one after the other.

    On accelerators, and without `vmap`, the function is not changed. This is useful for functions such as
    factorisations, if the whole batch would not fit in the cache.

    **Arguments:**

    - `function`: function of arrays.

    **Example:**

    ```python
    inverses = jax.vmap(in_turn(jnp.linalg.inv))(jnp.stack([dense, 2 * dense]))
    ```
    """
    return differentiable_batches(function, map_one_by_one)


def differentiable_batches(function: Callable[..., Any], batch_rule: Callable[..., Any]) -> Callable[..., Any]:
    """Give `function` the behaviour `batch_rule` under `jax.vmap`, and keep its usual derivatives.

    `batch_rule(batchable, plain, axis_size, batched, *arguments)` returns outputs that all have the batch as leading
    axis. `batchable` is the function with the batch rule, for nested batches; `plain` is the function without the batch
    rule.
    """

    @custom_vmap
    def batchable(*arguments):
        return function(*arguments)

    @batchable.def_vmap
    def _(axis_size, batched, *arguments):
        outputs = batch_rule(batchable, function, axis_size, batched, *arguments)
        return outputs, jax.tree.map(lambda _: True, outputs)

    # Functions with a custom batching rule have no transpose, so derivatives are taken of the plain function.
    @jax.custom_jvp
    def differentiable(*arguments):
        return batchable(*arguments)

    @partial(differentiable.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        leaves, structure = jax.tree.flatten(primals)
        directions = jax.tree.leaves(tangents, is_leaf=_is_zero_tangent)
        moving_indices = [number for number, direction in enumerate(directions) if not _is_zero_tangent(direction)]

        def moving_function(*values):
            all_leaves = list(leaves)
            for number, value in zip(moving_indices, values, strict=True):
                all_leaves[number] = value
            return function(*jax.tree.unflatten(structure, all_leaves))

        return jax.jvp(moving_function, [leaves[i] for i in moving_indices], [directions[i] for i in moving_indices])

    return differentiable


def _is_zero_tangent(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def map_one_by_one(
    batched_function: Callable[..., Any],
    unbatched_function: Callable[..., Any],
    axis_size: int,
    batched_flags: Any,
    *arguments: Any,
) -> Any:
    """Call a function for each element of a batch: one after the other on a CPU, all at once on accelerators."""
    del axis_size
    leaves, structure = jax.tree.flatten(arguments)
    batch_flags = jax.tree.leaves(batched_flags)
    batched_leaves = [leaf for leaf, is_batched in zip(leaves, batch_flags, strict=True) if is_batched]
    shared_leaves = [leaf for leaf, is_batched in zip(leaves, batch_flags, strict=True) if not is_batched]

    def call_once(function, own_values, constants):
        own_values, constants = iter(own_values), iter(constants)
        return function(
            *jax.tree.unflatten(
                structure, [next(own_values) if is_batched else next(constants) for is_batched in batch_flags]
            )
        )

    def call_in_turn(batched_leaves, shared_leaves):
        return jax.lax.map(lambda own_values: call_once(batched_function, own_values, shared_leaves), batched_leaves)

    def call_together(batched_leaves, shared_leaves):
        return jax.vmap(lambda own_values: call_once(unbatched_function, own_values, shared_leaves))(batched_leaves)

    return jax.lax.platform_dependent(batched_leaves, shared_leaves, cpu=call_in_turn, default=call_together)


_FunctionType = TypeVar("_FunctionType", bound=Callable[..., Any])

_IMPORTING_PROCESS_ID = os.getpid()
# Size of a complex step for derivatives; its square is negligible in double precision.
_COMPLEX_STEP = 1e-100


host: Any = np
"""NumPy with the type Any, for NumPy arrays in places where JAX arrays are declared."""


def namespace(*trees: Any) -> Any:
    """Return `numpy` if these pytrees contain no JAX array, else `jax.numpy`."""
    return jnp if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(trees)) else np


def has_values(*trees: Any) -> bool:
    """Whether the values of all arrays in these pytrees are known, i.e. no array is being traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def is_forked() -> bool:
    """Whether this process was forked from the process that imported this module; compiled code may hang in a fork."""
    return os.getpid() != _IMPORTING_PROCESS_ID


def on_host(tree: Any) -> Any:
    """Convert the JAX arrays of a pytree, except traced arrays, to NumPy arrays; on a CPU both share their memory."""
    return jax.tree.map(_on_host, tree)


def _on_host(leaf: Any) -> Any:
    return np.asarray(leaf) if isinstance(leaf, jax.Array) and not isinstance(leaf, Tracer) else leaf


def on_device(tree: Any) -> Any:
    """Convert the NumPy arrays of a pytree to JAX arrays. Inside a function that JAX traces they stay constants with
    known values. Arrays from `empty_for_jax` are not copied."""
    with jax.ensure_compile_time_eval():
        return jax.tree.map(_on_device, tree)


def _on_device(pytree_leaf: Any) -> Any:
    return jax.device_put(pytree_leaf) if isinstance(pytree_leaf, np.ndarray | np.generic) else pytree_leaf


# Size in bytes from which an array is allocated in memory that JAX can use without a copy (copying smaller arrays is
# faster), and alignment in bytes that JAX requires of such memory.
_MIN_SHARED_BYTES, _JAX_ALIGNMENT = 1_000_000, 64


def empty_for_jax(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return an uninitialised NumPy array whose memory JAX can use without a copy."""
    num_bytes = math.prod(shape) * dtype.itemsize
    padded_memory = np.empty(num_bytes + _JAX_ALIGNMENT, np.uint8)
    aligned_start = -padded_memory.ctypes.data % _JAX_ALIGNMENT
    return padded_memory[aligned_start : aligned_start + num_bytes].view(dtype).reshape(shape)


def product_for_jax(
    left_matrix: Inexact[np.ndarray, "*f k"], right_matrix: Inexact[np.ndarray, "k m"]
) -> Inexact[Array, "*f m"]:
    """Multiply two NumPy matrices and return the product as a JAX array. A large product is computed in memory that JAX
    can use without a copy, because a copy would take longer than the product."""
    shape, dtype = (*left_matrix.shape[:-1], right_matrix.shape[1]), np.result_type(left_matrix, right_matrix)
    if math.prod(shape) * dtype.itemsize < _MIN_SHARED_BYTES:
        return _to_jax(left_matrix @ right_matrix)
    return jax.device_put(np.matmul(left_matrix, right_matrix, out=empty_for_jax(shape, dtype)))


@jax.jit
def _to_jax(host_array) -> Any:
    """Convert a NumPy array to a JAX array in a quarter of the time of `jax.device_put`. This conversion cannot be used
    in forked processes, where compiled functions do not run."""
    return host_array


def as_array(values: Any, dtype: Any = None) -> Array:
    """Copy values, known or traced, to a JAX array, so that later changes of the caller's array have no effect.

    `jax.numpy.asarray`, in contrast, may share the memory, and compiles a program for every shape.
    """
    if has_values(values):
        with jax.ensure_compile_time_eval():  # known values stay known inside a traced program
            return jax.device_put(np.array(values, dtype and jax.dtypes.canonicalize_dtype(dtype)))
    return jnp.asarray(values, dtype)


def evaluate_in_numpy(function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Return the result of `function` for arrays with known values, computed in NumPy."""
    arguments, named = on_host((arguments, named))
    with np.errstate(all="ignore"):  # JAX does not warn of floating-point errors either
        return function(*arguments, **named)


def numpy_or_compiled(function: _FunctionType) -> _FunctionType:
    """Make `function` of arrays run in NumPy if all values are known, and in a compiled program if any array is traced.

    The results are JAX arrays, unless all arguments are NumPy arrays.
    """
    compiled_function = jax.jit(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        leaves = jax.tree.leaves((arguments, named))
        if not has_values(leaves):
            return compiled_function(*arguments, **named)
        result = evaluate_in_numpy(function, *arguments, **named)
        return result if namespace(leaves) is np else on_device(result)

    return call  # pyright: ignore[reportReturnType]


def values_at_once(function: _FunctionType) -> _FunctionType:
    """Make `function` of arrays run in NumPy if all values are known, and unchanged, not compiled, if any array is
    traced.

    This suits functions that must read some values even if other arrays are traced, which `numpy_or_compiled` does not
    allow. The results are JAX arrays, unless all arguments are NumPy arrays.
    """

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        arguments_and_keywords = arguments, named
        if namespace(arguments_and_keywords) is np or not has_values(arguments_and_keywords):
            return function(*arguments, **named)
        return on_device(evaluate_in_numpy(function, *arguments, **named))

    return call  # pyright: ignore[reportReturnType]


class RecentResultsCache:
    """Cache of the last few results of a function of immutable pytrees. A result is reused if the arguments, or the
    arrays in them, are the same objects as before."""

    def __init__(self, make: Callable[..., Any], size: int = 4):
        self._make_result, self._max_results = make, size
        self._cached_results: list[tuple[tuple[Any, ...], list[Any], Any, Any]] = []

    def __call__(self, *trees: Any) -> Any:
        """Return the result of `make` for these arguments, computed now or taken from the cache."""
        cached_results = self._cached_results[::-1]
        for cached_key, _, _, result in cached_results:
            if _are_identical(cached_key, trees):
                return result
        leaves, structure = jax.tree.flatten(trees)
        for _, cached_key, treedef, result in cached_results:
            if _are_identical(cached_key, leaves) and treedef == structure:  # structures take far longer to compare
                return result
        result = self._make_result(*trees)
        self._cached_results = [*self._cached_results, (trees, leaves, structure, result)][-self._max_results :]
        return result


def _are_identical(first: Sequence[Any], second: Sequence[Any]) -> bool:
    return len(first) == len(second) and all(left is right for left, right in zip(first, second, strict=True))


def undifferentiated(values: Any) -> Any:
    """Return a pytree of arrays that differentiation treats as constant."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.Array) else leaf, values)


def computed_once(values: Any) -> Any:
    """Return the same arrays, which XLA then computes only once, instead of again in every place where they are
    used."""
    return values if namespace(values) is np else jax.lax.optimization_barrier(values)


def adjoint(matrix: Any) -> Any:
    """Conjugate transpose of a matrix (m, n); for a real matrix the transpose, as a view."""
    return matrix.conj().T if np.iscomplexobj(matrix) else matrix.T


def while_loop(condition: Callable[[Any], Any], body: Callable[[Any], Any], state: Any) -> Any:
    """Return the state after repeating `body` while `condition` holds; runs `jax.lax.while_loop` for JAX arrays."""
    if namespace(state) is jnp:
        return jax.lax.while_loop(condition, body, state)
    while condition(state):
        state = body(state)
    return state


def scan(body: Callable[[Any, Any], tuple[Any, Any]], state: Any, elements: Any, *, reverse: bool = False) -> Any:
    """Apply `body(state, element)` along the first axis of `elements`; returns the last state and the stacked outputs.
    Runs `jax.lax.scan` for JAX arrays; in NumPy at least one element is needed."""
    if namespace(state, elements) is jnp:
        return jax.lax.scan(body, state, elements, reverse=reverse)
    outputs: Any = [None] * len(jax.tree.leaves(elements)[0])
    for k in sorted(range(len(outputs)), reverse=reverse):
        state, outputs[k] = body(state, jax.tree.map(lambda array, k=k: array[k], elements))
    return state, jax.tree.map(lambda *rows: np.stack(rows), *outputs)


def complex_slope(function: Callable[[Any], Any], x: Any, row_index: int) -> Any:
    """Derivative of `function` with respect to one row of a NumPy array x (n, F), by a complex step. The columns of x
    are independent arguments; see `slopes`."""
    return _complex_step(function, x, row_index)[1]


def _complex_step(function, x, argument_row: int) -> tuple[Any, Any]:
    shifted_point = x.astype(complex)
    shifted_point[argument_row] += 1j * _COMPLEX_STEP
    complex_values = function(shifted_point)
    return jax.tree.map(np.real, complex_values), jax.tree.map(
        lambda complex_value: np.imag(complex_value) / _COMPLEX_STEP, complex_values
    )


def slopes(function: Callable[[Any], Any], x: Any) -> tuple[Any, list[Any]]:
    """Values of `function` at x (n, F), and its derivatives with respect to each of the n rows of x; the columns are
    independent arguments.

    NumPy uses complex steps (Squire and Trapp, SIAM Rev. 40, 1998, 110-112), which are exact to rounding if the
    function is analytic. JAX uses forward differentiation.
    """
    if isinstance(x, np.ndarray):
        values_and_slopes = [_complex_step(function, x, argument_row) for argument_row in range(len(x))]
        return values_and_slopes[0][0], [row_slope for _, row_slope in values_and_slopes]
    value, derivative = jax.linearize(function, x)
    return value, [derivative(direction) for direction in jnp.eye(len(x))[:, :, None] * jnp.ones_like(x)]


def gather(values: Shaped[Array, "n *k"], index: Int[Array, "*i"]) -> Shaped[Array, "..."]:
    """Rows of `values` at the indices `index`, which must be valid and are not checked."""
    if isinstance(values, np.ndarray):
        return values[np.asarray(index)]  # pyright: ignore[reportReturnType]
    return values.at[index].get(mode="promise_in_bounds")


def gather_or_zero(values: Shaped[Array, "n *k"], index: Int[Array, "*i"]) -> Shaped[Array, "..."]:
    """Rows of `values` (n, …) at the indices `index`, with a row of zeros for the index n."""
    if isinstance(values, np.ndarray):
        if not len(values):
            return host.zeros((*np.shape(index), *values.shape[1:]), values.dtype)
        rows = np.take(values, index, axis=0, mode="clip")  # avoids a copy of all rows with a row of zeros appended
        rows[np.asarray(index) == len(values)] = 0
        return host.asarray(rows)
    return values.at[index].get(mode="fill", fill_value=0)


def replace_at(values: Shaped[Array, " n"], index: Any, value: Any) -> Shaped[Array, " n"]:
    """Copy of `values` with `value` at `index`; unchanged if the index lies beyond the end."""
    if isinstance(values, np.ndarray):
        return np.where(np.arange(values.size) == index, value, values)  # pyright: ignore[reportReturnType]
    return values.at[index].set(value, mode="drop")


def sum_into(shape: tuple[int, ...], index: Any, values: Inexact[Array, "*i"]) -> Inexact[Array, "*n"]:
    """Add `values` at `index` to an array of zeros of the specified shape; repeated indices accumulate."""
    return add_at(namespace(values).zeros(shape, values.dtype), index, values)


def set_at(total: Shaped[Array, "*n"], index: Any, values: Any) -> Shaped[Array, "*n"]:
    """Copy of `total` with the entries at `index` replaced by `values`; JAX ignores indices beyond the end."""
    if isinstance(total, np.ndarray):
        copied_total: Any = np.array(total)
        copied_total[index] = values
        return copied_total
    return total.at[index].set(values, mode="drop")


def add_at(total: Inexact[Array, "*n"], index: Any, values: Inexact[Array, "*i"]) -> Inexact[Array, "*n"]:
    """Copy of `total` with `values` added at `index`; repeated indices accumulate."""
    return add_into(host.array(total) if isinstance(total, np.ndarray) else total, index, values)


def add_into(total: Inexact[Array, "*n"], index: Any, values: Inexact[Array, "*i"]) -> Inexact[Array, "*n"]:
    """Add `values` to `total` as `add_at` does, but change a NumPy array `total` in place."""
    if isinstance(total, np.ndarray):
        np.add.at(total, index, values)
        return host.asarray(total)
    return total.at[index].add(values)


def call_numpy(function: Callable[..., Any], shape: jax.ShapeDtypeStruct, *arguments: Any) -> Any:
    """Return the array that a `function` of NumPy arrays returns, also for traced arguments: the compiled program calls
    NumPy.

    The function gets views of the program's memory. `jax.pure_callback` would copy the arguments into JAX arrays, which
    needs a free thread of XLA. If as many programs called at once as XLA has threads, all of them would wait for ever.
    Under `jax.vmap` the function is called for the elements of the batch one after the other. The function is not
    differentiated.
    """
    return _numpy_call.bind(*arguments, function=function, shape=tuple(shape.shape), kind=np.dtype(shape.dtype))


_numpy_call = Primitive("jeit_numpy_call")


@_numpy_call.def_impl
def _(*arguments: Any, function: Callable[..., Any], shape: tuple[int, ...], kind: np.dtype) -> Any:
    del shape, kind
    return jnp.asarray(function(*map(np.asarray, arguments)))


@_numpy_call.def_abstract_eval
def _(*arguments: Any, function: Callable[..., Any], shape: tuple[int, ...], kind: np.dtype) -> Any:
    del arguments, function
    return ShapedArray(shape, kind)


def _lower_numpy_call(lowering_context: Any, *arguments: Any, function: Callable[..., Any], **_: Any) -> Any:
    def call_on_host(*values: Any) -> tuple[np.ndarray]:
        return (function(*map(np.asarray, values)),)

    results, _, _ = mlir.emit_python_callback(
        lowering_context,
        call_on_host,
        None,
        list(arguments),
        lowering_context.avals_in,
        lowering_context.avals_out,
        has_side_effect=False,
        returns_token=False,
    )
    return results


def _batch_numpy_call(arguments: Sequence[Any], axes: Sequence[Any], **parameters: Any) -> tuple[Any, int]:
    batched_arguments = [
        jnp.moveaxis(argument, axis, 0) for argument, axis in zip(arguments, axes, strict=True) if axis is not None
    ]

    def call_for_element(element_arguments: list[Any]) -> Any:
        elements = iter(element_arguments)
        return _numpy_call.bind(
            *(argument if axis is None else next(elements) for argument, axis in zip(arguments, axes, strict=True)),
            **parameters,
        )

    return jax.lax.map(call_for_element, batched_arguments), 0


mlir.register_lowering(_numpy_call, _lower_numpy_call)
batching.primitive_batchers[_numpy_call] = _batch_numpy_call
