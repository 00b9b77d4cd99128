"""Batching rules of the direct solver under `jax.vmap`: matrices one after the other on a CPU, right-hand sides all at
once.

A batch of factorisations side by side streams all of the batch through memory at every stage, and takes more than
twice as long per matrix as one that stays in the cache. Accelerators do get the whole batch at once.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero


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
