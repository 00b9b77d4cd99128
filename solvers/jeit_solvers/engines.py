"""One formula, two engines: NumPy where values are at hand, JAX where they are traced, batched or differentiated.

JAX traces and compiles a program before it runs, which takes seconds; NumPy runs at once, and is as quick on large
arrays. So what is asked for once runs in NumPy, and what is asked for a thousand times, or differentiated, in a
compiled program; a formula written with the functions below, and with what `numpy` and `jax.numpy` have in common, goes
through both.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Inexact, Int, Shaped

_Function = TypeVar("_Function", bound=Callable[..., Any])


host: Any = np
"""NumPy, for arrays that are to go where JAX's are declared."""


def namespace(*trees: Any) -> Any:
    """`numpy` if every array of these pytrees is NumPy's, else `jax.numpy`."""
    return jnp if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(trees)) else np


def has_values(*trees: Any) -> bool:
    """Whether all arrays of these pytrees have values that can be looked at, i.e. none is being traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def on_host(tree: Any) -> Any:
    """The pytree with NumPy's arrays in place of JAX's; on a CPU they share their memory."""
    return jax.tree.map(lambda leaf: np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf, tree)


def on_device(tree: Any) -> Any:
    """The pytree with JAX's arrays in place of NumPy's."""
    return jax.tree.map(lambda leaf: jax.device_put(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf, tree)


def as_array(values: Any, dtype: Any = None) -> Array:
    """JAX's array of values that are at hand or traced, a copy: who gave them may write into theirs.

    `jax.numpy.asarray` may share the memory, and compiles a program for every shape.
    """
    if has_values(values):
        return jax.device_put(np.array(values, dtype and jax.dtypes.canonicalize_dtype(dtype)))
    return jnp.asarray(values, dtype)


def either_engine(function: _Function) -> _Function:
    """`function` of arrays: in NumPy, at once, where all have values; compiled as a whole where any is traced.

    What it returns are JAX's arrays, unless all it was given are NumPy's.
    """
    compiled = jax.jit(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        given, structure = jax.tree.flatten((arguments, named))  # once: on small arrays it is what takes time
        if not has_values(given):
            return compiled(*arguments, **named)
        arguments, named = jax.tree.unflatten(structure, on_host(given))
        with np.errstate(all="ignore"):  # JAX says nothing of them either
            result = function(*arguments, **named)
        return result if namespace(given) is np else on_device(result)

    return call  # pyright: ignore[reportReturnType]


class Recent:
    """Keeps the last few results of a function of pytrees, known again by the identity of the arrays they came of."""

    def __init__(self, make: Callable[..., Any], size: int = 4):
        self._make, self._size = make, size
        self._kept: list[tuple[list[Any], Any, Any]] = []

    def __call__(self, *trees: Any) -> Any:
        """What `make` returns of these, or has returned."""
        leaves, structure = jax.tree.flatten(trees)
        for known, kind, result in reversed(self._kept):
            if kind == structure and all(one is other for one, other in zip(known, leaves, strict=True)):
                return result
        result = self._make(*trees)
        self._kept = [*self._kept[1 - self._size :], (leaves, structure, result)]
        return result


def undifferentiated(values: Any) -> Any:
    """The same values, which no derivative goes through."""
    return values if isinstance(values, np.ndarray) else jax.lax.stop_gradient(values)


def gather(values: Shaped[Array, "n *k"], index: Int[Array, "*i"]) -> Shaped[Array, "..."]:
    """Rows of `values`; the indices are known to be there."""
    if isinstance(values, np.ndarray):
        return values[np.asarray(index)]  # pyright: ignore[reportReturnType]
    return values.at[index].get(mode="promise_in_bounds")


def gather_or_zero(values: Shaped[Array, "n *k"], index: Int[Array, "*i"]) -> Shaped[Array, "..."]:
    """Rows of `values`, zeros for the index n."""
    if isinstance(values, np.ndarray):
        return np.concatenate([values, np.zeros((1, *values.shape[1:]), values.dtype)])[index]
    return values.at[index].get(mode="fill", fill_value=0)


def replace_at(values: Shaped[Array, " n"], index: Any, value: Any) -> Shaped[Array, " n"]:
    """`values` with another one at an index; the same where it lies beyond the end."""
    if isinstance(values, np.ndarray):
        return np.where(np.arange(values.size) == index, value, values)  # pyright: ignore[reportReturnType]
    return values.at[index].set(value, mode="drop")


def sum_into(shape: tuple[int, ...], index: Any, values: Inexact[Array, "*i"]) -> Inexact[Array, "*n"]:
    """Zeros of this shape, to which `values` are added at `index`, repeated indices again and again."""
    return add_at(namespace(values).zeros(shape, values.dtype), index, values)


def add_at(total: Inexact[Array, "*n"], index: Any, values: Inexact[Array, "*i"]) -> Inexact[Array, "*n"]:
    """`total` with `values` added at `index`, repeated indices again and again."""
    if isinstance(total, np.ndarray):
        grown: Any = host.array(total)
        np.add.at(grown, index, values)
        return grown
    return total.at[index].add(values)
