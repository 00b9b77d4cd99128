"""Two engines for one formula: NumPy for values, JAX for traced arrays; and batches over them.

Batching rules of the direct solver under `jax.vmap`: matrices one after the other on a CPU, right-hand sides all at
once.

A batch of factorisations side by side streams all of the batch through memory at every stage, and takes more than
twice as long per matrix as one that stays in the cache. Accelerators do get the whole batch at once.

One formula for two engines: NumPy where values are known, JAX where they are traced, batched or differentiated.

JAX traces and compiles a program before it runs, which takes seconds; NumPy runs at once, and is as quick on large
arrays. So what is asked for once runs in NumPy, and what is asked for a thousand times, or differentiated, in a
compiled program; a formula written with the functions below, and with what `numpy` and `jax.numpy` have in common, goes
through both.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Inexact, Int, Shaped


def in_turn(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of arrays that `jax.vmap` calls for one element of the batch after the other on a CPU.

    On accelerators, and in every other respect, it is the function itself. Worth it for functions that need more
    memory than fits the cache when a whole batch of them runs side by side, like anything with a factorisation in it.
    """
    return differentiable_batches(function, one_by_one)


def differentiable_batches(function: Callable[..., Any], batch_rule: Callable[..., Any]) -> Callable[..., Any]:
    """`function` with `batch_rule` for its behaviour under vmap, and the derivatives it has by itself.

    `batch_rule(batchable, plain, axis_size, batched, *arguments)` returns outputs that all have the batch as leading
    axis. `batchable` is the function as it may be batched once more, `plain` the function without the rule.
    """

    @custom_vmap
    def batchable(*arguments):
        return function(*arguments)

    @batchable.def_vmap
    def _(axis_size, batched, *arguments):
        outputs = batch_rule(batchable, function, axis_size, batched, *arguments)
        return outputs, jax.tree.map(lambda _: True, outputs)

    # Functions with a batching rule have no transpose: derivatives are taken of the plain function.
    @jax.custom_jvp
    def differentiable(*arguments):
        return batchable(*arguments)

    @partial(differentiable.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        leaves, structure = jax.tree.flatten(primals)
        directions = jax.tree.leaves(tangents, is_leaf=_is_zero)
        moving = [number for number, direction in enumerate(directions) if not _is_zero(direction)]

        def of_what_moves(*values):
            merged = list(leaves)
            for number, value in zip(moving, values, strict=True):
                merged[number] = value
            return function(*jax.tree.unflatten(structure, merged))

        return jax.jvp(of_what_moves, [leaves[i] for i in moving], [directions[i] for i in moving])

    return differentiable


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def one_by_one(
    batchable: Callable[..., Any], plain: Callable[..., Any], axis_size: int, batched: Any, *arguments: Any
) -> Any:
    """Call a function for each element of a batch: in turn on a CPU, side by side on accelerators."""
    del axis_size
    leaves, structure = jax.tree.flatten(arguments)
    flags = jax.tree.leaves(batched)
    chosen = [leaf for leaf, flag in zip(leaves, flags, strict=True) if flag]
    shared = [leaf for leaf, flag in zip(leaves, flags, strict=True) if not flag]

    def call(function, own, common):
        own, common = iter(own), iter(common)
        return function(*jax.tree.unflatten(structure, [next(own) if flag else next(common) for flag in flags]))

    def one_after_the_other(chosen, shared):
        return jax.lax.map(lambda own: call(batchable, own, shared), chosen)

    def together(chosen, shared):
        return jax.vmap(lambda own: call(plain, own, shared))(chosen)

    return jax.lax.platform_dependent(chosen, shared, cpu=one_after_the_other, default=together)


_Function = TypeVar("_Function", bound=Callable[..., Any])

_PROCESS = os.getpid()
# Complex step, so small that its square vanishes beside any number.
_COMPLEX_STEP = 1e-100


host: Any = np
"""NumPy, for arrays that are to go where JAX's are declared."""


def namespace(*trees: Any) -> Any:
    """`numpy` if every array of these pytrees is NumPy's, else `jax.numpy`."""
    return jnp if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(trees)) else np


def has_values(*trees: Any) -> bool:
    """Whether all arrays of these pytrees have values that can be looked at, i.e. none is being traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def is_forked() -> bool:
    """Whether this process was forked from the one that imported this: nothing compiled need run here."""
    return os.getpid() != _PROCESS


def on_host(tree: Any) -> Any:
    """The pytree with NumPy's arrays in place of JAX's, but for those that are traced; on a CPU they share their
    memory."""
    return jax.tree.map(_on_host, tree)


def _on_host(leaf: Any) -> Any:
    return np.asarray(leaf) if isinstance(leaf, jax.Array) and not isinstance(leaf, Tracer) else leaf


def on_device(tree: Any) -> Any:
    """The pytree with JAX's arrays in place of NumPy's; they keep their values where something else is traced."""
    with jax.ensure_compile_time_eval():
        return jax.tree.map(_on_device, tree)


def _on_device(leaf: Any) -> Any:
    return jax.device_put(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf


def as_array(values: Any, dtype: Any = None) -> Array:
    """JAX's array of values that are at hand or traced, a copy: who gave them may write into theirs.

    `jax.numpy.asarray` may share the memory, and compiles a program for every shape.
    """
    if has_values(values):
        with jax.ensure_compile_time_eval():  # what has values keeps them where something else is traced
            return jax.device_put(np.array(values, dtype and jax.dtypes.canonicalize_dtype(dtype)))
    return jnp.asarray(values, dtype)


def at_once(function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Result of `function` for arrays that have values, computed in NumPy."""
    arguments, named = on_host((arguments, named))
    with np.errstate(all="ignore"):  # JAX says nothing of them either
        return function(*arguments, **named)


def either_engine(function: _Function) -> _Function:
    """`function` of arrays: in NumPy, at once, where all have values; compiled as a whole where any is traced.

    What it returns are JAX's arrays, unless all it was given are NumPy's.
    """
    compiled = jax.jit(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        given = jax.tree.leaves((arguments, named))
        if not has_values(given):
            return compiled(*arguments, **named)
        result = at_once(function, *arguments, **named)
        return result if namespace(given) is np else on_device(result)

    return call  # pyright: ignore[reportReturnType]


def values_at_once(function: _Function) -> _Function:
    """`function` of arrays: in NumPy, at once, where all have values; as it is where any is traced.

    For what must see some values even where others are traced, which `either_engine` does not let it. What it returns
    are JAX's arrays, unless all it was given are NumPy's.
    """

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        given = arguments, named
        if namespace(given) is np or not has_values(given):
            return function(*arguments, **named)
        return on_device(at_once(function, *arguments, **named))

    return call  # pyright: ignore[reportReturnType]


class Recent:
    """Keeps the last few results of a function of pytrees, known again by the identity of the arrays they came of."""

    def __init__(self, make: Callable[..., Any], size: int = 4):
        self._make, self._size = make, size
        self._kept: list[tuple[list[Any], Any, Any]] = []

    def __call__(self, *trees: Any) -> Any:
        """The result of `make` for these arguments, computed or remembered."""
        leaves, structure = jax.tree.flatten(trees)
        for known, kind, result in reversed(self._kept):
            if kind == structure and all(one is other for one, other in zip(known, leaves, strict=True)):
                return result
        result = self._make(*trees)
        self._kept = [*self._kept[1 - self._size :], (leaves, structure, result)]
        return result


def undifferentiated(values: Any) -> Any:
    """The same pytree of arrays, which no derivative goes through."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.Array) else leaf, values)


def kept(values: Any) -> Any:
    """The same pytree of arrays, computed once: otherwise XLA may compute them again wherever they are used."""
    return values if namespace(values) is np else jax.lax.optimization_barrier(values)


def adjoint(matrix: Any) -> Any:
    """The conjugate transpose of a matrix (m, n); of a real one the transpose, a view."""
    return matrix.conj().T if np.iscomplexobj(matrix) else matrix.T


def while_loop(condition: Callable[[Any], Any], body: Callable[[Any], Any], state: Any) -> Any:
    """The state after so many turns of `body` as `condition` asks for; `jax.lax.while_loop` of JAX's arrays."""
    if namespace(state) is jnp:
        return jax.lax.while_loop(condition, body, state)
    while condition(state):
        state = body(state)
    return state


def scan(body: Callable[[Any, Any], tuple[Any, Any]], state: Any, each: Any, *, reverse: bool = False) -> Any:
    """The last state of `body(state, one)`, turn by turn along the first axis of `each`, and what it gave besides,
    stacked; at least one turn in NumPy, `jax.lax.scan` of JAX's arrays."""
    if namespace(state, each) is jnp:
        return jax.lax.scan(body, state, each, reverse=reverse)
    given: Any = [None] * len(jax.tree.leaves(each)[0])
    for k in sorted(range(len(given)), reverse=reverse):
        state, given[k] = body(state, jax.tree.map(lambda array, k=k: array[k], each))
    return state, jax.tree.map(lambda *parts: np.stack(parts), *given)


def complex_slope(function: Callable[[Any], Any], x: Any, row: int) -> Any:
    """The derivative of `function` of NumPy's x (n, F) along a row; columns are independent. See `slopes`."""
    return _complex_step(function, x, row)[1]


def _complex_step(function, x, row: int) -> tuple[Any, Any]:
    ahead = x.astype(complex)
    ahead[row] += 1j * _COMPLEX_STEP
    found = function(ahead)
    return jax.tree.map(np.real, found), jax.tree.map(lambda part: np.imag(part) / _COMPLEX_STEP, found)


def slopes(function: Callable[[Any], Any], x: Any) -> tuple[Any, list[Any]]:
    """Values of `function` at x (n, F), and its derivatives along each of the n rows; columns are independent.

    In NumPy by complex steps (Squire and Trapp, SIAM Rev. 40, 1998, 110-112), exact to rounding: the function must be
    analytic. In JAX by forward differentiation.
    """
    if isinstance(x, np.ndarray):
        ahead = [_complex_step(function, x, row) for row in range(len(x))]
        return ahead[0][0], [slope for _, slope in ahead]
    value, push = jax.linearize(function, x)
    return value, [push(direction) for direction in jnp.eye(len(x))[:, :, None] * jnp.ones_like(x)]


def gather(values: Shaped[Array, "n *k"], index: Int[Array, "*i"]) -> Shaped[Array, "..."]:
    """Rows of `values`; the indices are known to be there."""
    if isinstance(values, np.ndarray):
        return values[np.asarray(index)]  # pyright: ignore[reportReturnType]
    return values.at[index].get(mode="promise_in_bounds")


def gather_or_zero(values: Shaped[Array, "n *k"], index: Int[Array, "*i"]) -> Shaped[Array, "..."]:
    """Rows of `values`, zeros for the index n."""
    if isinstance(values, np.ndarray):
        if not len(values):
            return host.zeros((*np.shape(index), *values.shape[1:]), values.dtype)
        found = np.take(values, index, axis=0, mode="clip")  # no copy of all of them, with a row of zeros at the end
        found[np.asarray(index) == len(values)] = 0
        return host.asarray(found)
    return values.at[index].get(mode="fill", fill_value=0)


def replace_at(values: Shaped[Array, " n"], index: Any, value: Any) -> Shaped[Array, " n"]:
    """`values` with another one at an index; the same where it lies beyond the end."""
    if isinstance(values, np.ndarray):
        return np.where(np.arange(values.size) == index, value, values)  # pyright: ignore[reportReturnType]
    return values.at[index].set(value, mode="drop")


def sum_into(shape: tuple[int, ...], index: Any, values: Inexact[Array, "*i"]) -> Inexact[Array, "*n"]:
    """Zeros of this shape, to which `values` are added at `index`, repeated indices again and again."""
    return add_at(namespace(values).zeros(shape, values.dtype), index, values)


def set_at(total: Shaped[Array, "*n"], index: Any, values: Any) -> Shaped[Array, "*n"]:
    """`total` with `values` in place of those at `index`; indices beyond the end, of JAX's arrays, are passed over."""
    if isinstance(total, np.ndarray):
        changed: Any = np.array(total)
        changed[index] = values
        return changed
    return total.at[index].set(values, mode="drop")


def add_at(total: Inexact[Array, "*n"], index: Any, values: Inexact[Array, "*i"]) -> Inexact[Array, "*n"]:
    """`total` with `values` added at `index`, repeated indices again and again."""
    return add_into(host.array(total) if isinstance(total, np.ndarray) else total, index, values)


def add_into(total: Inexact[Array, "*n"], index: Any, values: Inexact[Array, "*i"]) -> Inexact[Array, "*n"]:
    """The same in place of a `total` of NumPy's that nothing else needs."""
    if isinstance(total, np.ndarray):
        np.add.at(total, index, values)
        return host.asarray(total)
    return total.at[index].add(values)
