"""Many index arrays kept in one.

Every array and every module of a pytree costs microseconds each time it is passed to a jitted function; a plan has
dozens of index arrays, and a small factorisation takes half a millisecond. So plans and patterns keep all their
indices in one int32 array, and what a slice of it means in a static, hashable description.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Inexact, Int

from jeit_solvers.engines import add_into, as_array, gather, gather_or_zero, has_values, namespace, set_at


class Slot(NamedTuple):
    """Place of an index array in the store, and its shape."""

    start: int
    shape: tuple[int, ...]

    def read(self, indices: Int[Array, " total"]) -> Int[Array, "..."]:
        """The index array, out of the store it was packed in."""
        stop = self.start + math.prod(self.shape)
        if has_values(indices):
            return np.asarray(indices)[self.start : stop].reshape(self.shape)  # pyright: ignore[reportReturnType]
        return jax.lax.slice(indices, (self.start,), (stop,)).reshape(self.shape)


class IndexStore:
    """Collects index arrays while a plan is made."""

    def __init__(self):
        self._arrays: list[np.ndarray] = []
        self._total = 0

    def add(self, array: np.ndarray) -> Slot:
        """Keep an integer array; returns the slot to read it from later."""
        slot = Slot(self._total, tuple(array.shape))
        self._arrays.append(array.astype(np.int32).ravel())
        self._total += array.size
        return slot

    def pack(self) -> Int[Array, " total"]:
        """Join all arrays into one. Raises `ValueError` if there are more indices than 32 bits can count."""
        if self._total > np.iinfo(np.int32).max:
            raise ValueError(
                f"The plan needs {self._total} indices, more than 32-bit integers can count: the matrix fills in too "
                "much for the direct solver. Use `ConjugateGradient`."
            )
        return as_array(np.concatenate([np.empty(0, np.int32), *self._arrays]))


class PaddedSum(NamedTuple):
    """Sums of scattered contributions. Scattering is slow on a CPU, so most contributions are *gathered*.

    `gather` (width, sums) says which contributions each sum reads, with numbers out of range where it has fewer;
    `overflow_sum` and `overflow_source` pair sums with the contributions beyond `width`, which are scattered: in rounds
    that end at `rounds`, in each of which no sum is met twice and sums ascend.
    """

    gather: Slot
    overflow_sum: Slot
    overflow_source: Slot
    rounds: tuple[int, ...]

    @classmethod
    def create(
        cls, store: IndexStore, target: np.ndarray, source: np.ndarray, num_sums: int, num_sources: int
    ) -> "PaddedSum":
        """Plan to add contribution `source[i]` of `num_sources` into sum `target[i]` of `num_sums`, for all i."""
        order = np.argsort(target, kind="stable")
        target, source = target[order], source[order]
        counts = np.bincount(target, minlength=num_sums)
        rank = np.arange(target.size) - np.repeat(np.cumsum(counts) - counts, counts)
        # Number of contributions that each width would leave over; the width with the least predicted time is taken.
        left_over = target.size - np.concatenate([[0], np.cumsum(np.bincount(rank, minlength=1))])
        width = int(np.argmin(np.arange(left_over.size) * num_sums + _SCATTER_COST * left_over))
        gather = np.full((width, num_sums), num_sources, dtype=np.int32)
        inside = rank < width
        gather[rank[inside], target[inside]] = source[inside]
        rounds = np.argsort(rank, kind="stable")
        rounds = rounds[~inside[rounds]]
        ends = np.cumsum(np.bincount(rank[rounds] - width))
        return cls(store.add(gather), store.add(target[rounds]), store.add(source[rounds]), tuple(ends.tolist()))

    def apply(
        self, indices: Int[Array, " total"], contributions: Inexact[Array, "sources *k"]
    ) -> Inexact[Array, "sums *k"]:
        """The sums of the given contributions."""
        shape = self.gather.shape[1], *contributions.shape[1:]
        total = namespace(contributions).zeros(shape, contributions.dtype)
        if isinstance(contributions, np.ndarray):
            self.add_some(indices, contributions, total, 0, shape[0])
            return total
        gathered = self.gather.read(indices)
        for layer in range(len(gathered)):
            total += gather_or_zero(contributions, gathered[layer])
        if self.overflow_sum.shape[0]:
            overflow = gather(contributions, self.overflow_source.read(indices))
            total = add_into(total, self.overflow_sum.read(indices), overflow)
        return total

    def add_some(
        self, indices: Any, contributions: Inexact[Array, "sources *k"], total: Any, start: int, stop: int
    ) -> None:
        """In NumPy: the sums from `start` to before `stop`, added to a `total` (sums, k) in place; so many at a time
        that what is made on the way stays near the processor."""
        at_once = max(1, _AT_ONCE // math.prod(contributions.shape[1:]))
        gathered: Any = self.gather.read(indices)
        for first in range(start, stop, at_once) if len(gathered) else ():
            some = slice(first, min(first + at_once, stop))
            for layer in gathered:
                total[some] += gather_or_zero(contributions, layer[some])
        sums: Any = self.overflow_sum.read(indices)
        sources: Any = self.overflow_source.read(indices)
        for begin, end in zip((0, *self.rounds), self.rounds, strict=False):
            first, last = begin + np.searchsorted(sums[begin:end], (start, stop))
            for one in range(first, last, at_once):
                some = slice(one, min(one + at_once, last))
                total[sums[some]] += gather(contributions, sources[some])

    def read_back(
        self, indices: Int[Array, " total"], sums: Inexact[Array, " sums"], into: Inexact[Array, " sources"]
    ) -> Inexact[Array, " sources"]:
        """`into` with the sum that each contribution is added to in its place, one of them where it is added to more;
        it must have one place more than there are contributions, which is overwritten."""
        for layer in self.gather.read(indices):
            into = set_at(into, layer, sums)
        if self.overflow_sum.shape[0]:
            overflow = gather(sums, self.overflow_sum.read(indices))
            into = set_at(into, self.overflow_source.read(indices), overflow)
        return into


# Measured on two Zen 4 cores: a scattered contribution costs about as much as this many gathered ones.
_SCATTER_COST = 4.0
# Entries that NumPy gathers at a time.
_AT_ONCE = 16384


class IndexLayout:
    """A static description that hashes once: JAX hashes and compares it at every call of a jitted function."""

    def __init__(self, *content: Any):
        self.content = content
        self._hash = hash(content)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (
            isinstance(other, IndexLayout) and self._hash == other._hash and self.content == other.content
        )
