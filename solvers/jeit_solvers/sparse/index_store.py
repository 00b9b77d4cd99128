"""Storage of many index arrays in a single array.

Passing a pytree to a jitted function costs microseconds for each of its arrays and modules. A plan has dozens of index
arrays, and a small factorisation takes only half a millisecond. Therefore plans and patterns store all their indices in
one int32 array, and a static, hashable description contains the positions of the individual arrays.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Inexact, Int

from jeit_solvers.engines import add_into, as_array, gather, gather_or_zero, has_values, namespace, set_at


class IndexSlot(NamedTuple):
    """Position and shape of an index array in an `IndexStore`."""

    start: int
    shape: tuple[int, ...]

    def read(self, indices: Int[Array, " total"]) -> Int[Array, "..."]:
        """Read the index array from the packed store `indices`."""
        slot_stop = self.start + math.prod(self.shape)
        if has_values(indices):
            return np.asarray(indices)[self.start : slot_stop].reshape(self.shape)  # pyright: ignore[reportReturnType]
        return jax.lax.slice(indices, (self.start,), (slot_stop,)).reshape(self.shape)


class IndexStore:
    """Collects index arrays during the creation of a plan or pattern."""

    def __init__(self):
        self._stored_arrays: list[np.ndarray] = []
        self._total_size = 0

    def add(self, array: np.ndarray) -> IndexSlot:
        """Store an integer array, and return the `IndexSlot` from which the array is read later."""
        array_slot = IndexSlot(self._total_size, tuple(array.shape))
        self._stored_arrays.append(array.astype(np.int32).ravel())
        self._total_size += array.size
        return array_slot

    def pack(self) -> Int[Array, " total"]:
        """Concatenate all arrays. Raises `ValueError` if there are more indices than 32-bit integers can count."""
        if self._total_size > np.iinfo(np.int32).max:
            raise ValueError(
                f"The plan needs {self._total_size} indices, more than 32-bit integers can count: the matrix fills in "
                "too "
                "much for the direct solver. Use `ConjugateGradient`."
            )
        return as_array(np.concatenate([np.empty(0, np.int32), *self._stored_arrays]))


class PaddedSum(NamedTuple):
    """Plan for sums of scattered contributions. Scattering is slow on a CPU, so most contributions are *gathered*.

    `gather` (width, sums) contains the indices of up to `width` contributions to each sum, padded with an index out of
    range. Further contributions are scattered: `overflow_sum` contains the index of the sum, and `overflow_source` the
    index of the contribution. These pairs are divided into rounds that end at `rounds`; within a round the indices of
    the sums are ascending and distinct.
    """

    gather: IndexSlot
    overflow_sum: IndexSlot
    overflow_source: IndexSlot
    rounds: tuple[int, ...]

    @classmethod
    def create(
        cls, store: IndexStore, target: np.ndarray, source: np.ndarray, num_sums: int, num_sources: int
    ) -> "PaddedSum":
        """Plan the addition of contribution `source[i]` of `num_sources` to sum `target[i]` of `num_sums`, for all
        i."""
        sort_order = np.argsort(target, kind="stable")
        target, source = target[sort_order], source[sort_order]
        contributions_per_sum = np.bincount(target, minlength=num_sums)
        rank_in_sum = np.arange(target.size) - np.repeat(
            np.cumsum(contributions_per_sum) - contributions_per_sum, contributions_per_sum
        )
        # Number of contributions beyond each width; the width with the shortest predicted time is chosen.
        num_beyond_width = target.size - np.concatenate([[0], np.cumsum(np.bincount(rank_in_sum, minlength=1))])
        gather_width = int(
            np.argmin(np.arange(num_beyond_width.size) * num_sums + _RELATIVE_SCATTER_COST * num_beyond_width)
        )
        gather_indices = np.full((gather_width, num_sums), num_sources, dtype=np.int32)
        is_gathered = rank_in_sum < gather_width
        gather_indices[rank_in_sum[is_gathered], target[is_gathered]] = source[is_gathered]
        contribution_order = np.argsort(rank_in_sum, kind="stable")
        contribution_order = contribution_order[~is_gathered[contribution_order]]
        ends_of_rounds = np.cumsum(np.bincount(rank_in_sum[contribution_order] - gather_width))
        return cls(
            store.add(gather_indices),
            store.add(target[contribution_order]),
            store.add(source[contribution_order]),
            tuple(ends_of_rounds.tolist()),
        )

    def apply(
        self, indices: Int[Array, " total"], contributions: Inexact[Array, "sources *k"]
    ) -> Inexact[Array, "sums *k"]:
        """Compute all sums from the contributions, with the plan stored in `indices`."""
        sums_shape = self.gather.shape[1], *contributions.shape[1:]
        sum_total = namespace(contributions).zeros(sums_shape, contributions.dtype)
        if isinstance(contributions, np.ndarray):
            self.add_range(indices, contributions, sum_total, 0, sums_shape[0])
            return sum_total
        gathered_values = self.gather.read(indices)
        for layer_number in range(len(gathered_values)):
            sum_total += gather_or_zero(contributions, gathered_values[layer_number])
        if self.overflow_sum.shape[0]:
            overflow_values = gather(contributions, self.overflow_source.read(indices))
            sum_total = add_into(sum_total, self.overflow_sum.read(indices), overflow_values)
        return sum_total

    def add_range(
        self, indices: Any, contributions: Inexact[Array, "sources *k"], total: Any, start: int, stop: int
    ) -> None:
        """In NumPy, add the sums with indices from `start` up to, but not including, `stop` to `total` (sums, k) in
        place. The sums are processed in chunks, so that temporary arrays stay in the cache."""
        chunk_size = max(1, _NUMPY_CHUNK_SIZE // math.prod(contributions.shape[1:]))
        gather_layers: Any = self.gather.read(indices)
        for first_sum in range(start, stop, chunk_size) if len(gather_layers) else ():
            sum_chunk = slice(first_sum, min(first_sum + chunk_size, stop))
            for gather_layer in gather_layers:
                total[sum_chunk] += gather_or_zero(contributions, gather_layer[sum_chunk])
        overflow_sums: Any = self.overflow_sum.read(indices)
        overflow_sources: Any = self.overflow_source.read(indices)
        for round_start, round_end in zip((0, *self.rounds), self.rounds, strict=False):
            first_sum, last_sum = round_start + np.searchsorted(overflow_sums[round_start:round_end], (start, stop))
            for chunk_start in range(first_sum, last_sum, chunk_size):
                sum_chunk = slice(chunk_start, min(chunk_start + chunk_size, last_sum))
                total[overflow_sums[sum_chunk]] += gather(contributions, overflow_sources[sum_chunk])

    def replace_by_sums(
        self, indices: Int[Array, " total"], sums: Inexact[Array, " sums"], values: Inexact[Array, " sources"]
    ) -> Inexact[Array, " sources"]:
        """Return `values` with the entry of each contribution replaced by the sum to which the contribution is added
        (by one of these sums if there are several). `values` must have one more entry than there are contributions; the
        last entry is overwritten."""
        for gather_layer in self.gather.read(indices):
            values = set_at(values, gather_layer, sums)
        if self.overflow_sum.shape[0]:
            overflow_values = gather(sums, self.overflow_sum.read(indices))
            values = set_at(values, self.overflow_source.read(indices), overflow_values)
        return values


# Cost of a scattered contribution relative to a gathered contribution, measured on two Zen 4 cores.
_RELATIVE_SCATTER_COST = 4.0
# Number of entries that NumPy gathers at a time.
_NUMPY_CHUNK_SIZE = 16384


class IndexLayout:
    """A static description of index arrays that computes its hash only once, because JAX hashes and compares static
    arguments at every call of a jitted function."""

    def __init__(self, *content: Any):
        self.content = content
        self._layout_hash = hash(content)

    def __hash__(self) -> int:
        return self._layout_hash

    def __eq__(self, other: object) -> bool:
        return self is other or (
            isinstance(other, IndexLayout) and self._layout_hash == other._layout_hash and self.content == other.content
        )
