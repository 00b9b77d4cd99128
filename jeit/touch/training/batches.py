"""Rows of training data, in memory or read chunk by chunk, and the order of rows in batches."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Int

from jeit.arguments import describe


class Rows(Protocol):
    """Interface of training data whose rows are in chunks, for example for data sets larger than memory.

    `sizes`: number of rows of each chunk; `chunk`: method that returns the rows of one chunk; `fingerprint`: a text
    that changes if any row changes.
    """

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of rows of each chunk of the data."""
        ...

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the content of all rows: a text, the same in every process."""
        ...

    def chunk(self, index: int) -> Any:
        """Return the arrays (rows, …) of one chunk of the data, in tuples, dictionaries or modules.

        All chunks have the same arrays; only the number of rows may differ between chunks.
        """
        ...


class ArrayRows:
    """Training data in memory, as one chunk of rows.

    `arrays`: any tree of arrays, each (rows, …).
    """

    def __init__(self, arrays: Any, name: str = "training"):
        """Raises `ValueError`, with the `name` of the data, if there are no arrays, or the arrays differ in number of
        rows."""
        row_counts = {len(array) if np.ndim(array) else -1 for array in jax.tree.leaves(arrays)}
        if len(row_counts) != 1 or min(row_counts) < 1:
            raise ValueError(
                f"{name} must be arrays of one and the same number of rows, 1 or more, such as (inputs, targets); it "
                f"is {describe(arrays)} of {sorted(row_counts) or 'none'}."
            )
        self.arrays = arrays
        self.sizes = (row_counts.pop(),)

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the rows: SHA-256 of the arrays."""
        content_hash = hashlib.sha256()
        for array in jax.tree.leaves(self.arrays):
            contiguous_array = np.ascontiguousarray(array)
            content_hash.update(f"{contiguous_array.dtype} {contiguous_array.shape}".encode())
            content_hash.update(contiguous_array.data)
        return content_hash.hexdigest()

    def chunk(self, index: int) -> Any:
        """Return all rows of the arrays, which are a single chunk."""
        return self.arrays


class MappedRows:
    """Training data computed from other `rows` by a `function` of each chunk, which must not change the number of rows.

    `name`: description of the function and of everything that the function depends on, except the rows.
    """

    def __init__(self, rows: Rows, function: Callable[[Any], Any], name: str):
        self.rows, self.function, self.name = rows, function, name

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of rows of each chunk of the data."""
        return self.rows.sizes

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the rows that the function is applied to, followed by the name of the function."""
        return f"{self.rows.fingerprint}, {self.name}"

    def chunk(self, index: int) -> Any:
        """Return the rows of a chunk after applying the function to them."""
        return self.function(self.rows.chunk(index))


class ChunkBatches(NamedTuple):
    """Consecutive training batches of rows of one chunk.

    `chunk`: index of the chunk; `rows` (batches, batch size): indices of the rows of each batch; `first`: index of the
    first of these batches in the whole training.
    """

    chunk: int
    rows: Int[np.ndarray, "b batch"]
    first: int


class BatchOrder:
    """The random order in which rows of training data are put into batches.

    In every epoch, the chunks, and the rows within each chunk, are shuffled anew. Rows that remain when no full batch
    can be formed are left out of the epoch; the rows left out differ between epochs. `sizes`: number of rows of each
    chunk; `batch`: number of rows in a batch. The order depends only on `seed`, so that the index of a batch determines
    the rows of the batch.
    """

    def __init__(self, sizes: tuple[int, ...], batch: int, seed: list[int]):
        self.batch, self.seed = min(batch, *sizes), seed
        self.num_batches = [num_rows // self.batch for num_rows in sizes]
        self.sizes = sizes

    @property
    def batches_per_epoch(self) -> int:
        """Number of full batches in an epoch of training."""
        return sum(self.num_batches)

    def chunk_batches(self, first_batch: int, last_batch: int, max_batches: int) -> Iterator[ChunkBatches]:
        """Yield the training batches with indices from `first_batch` to `last_batch`, exclusive, grouped by chunk.

        `max_batches`: maximum number of batches in a group of one chunk.
        """
        while first_batch < last_batch:
            epoch, batch_in_epoch = divmod(first_batch, self.batches_per_epoch)
            chunk_order = self._draw_permutation(len(self.sizes), epoch)
            last_batch_of_chunks = np.cumsum([self.num_batches[chunk_index] for chunk_index in chunk_order])
            chunk_position = int(np.searchsorted(last_batch_of_chunks, batch_in_epoch, side="right"))
            chunk_number = int(chunk_order[chunk_position])
            batch_in_chunk = batch_in_epoch - (
                int(last_batch_of_chunks[chunk_position]) - self.num_batches[chunk_number]
            )
            group_size = min(
                max_batches, last_batch - first_batch, int(last_batch_of_chunks[chunk_position]) - batch_in_epoch
            )
            batch_rows = self._draw_permutation(self.sizes[chunk_number], epoch, 1 + chunk_number)[
                batch_in_chunk * self.batch :
            ][: group_size * self.batch]
            yield ChunkBatches(chunk_number, batch_rows.reshape(group_size, self.batch), first_batch)
            first_batch += group_size

    def _draw_permutation(self, num_elements: int, *seed_extension: int) -> np.ndarray:
        """Draw a random permutation of 0 … `num_elements` - 1, determined by the seed and by `seed_extension`: the
        epoch, or the epoch and the chunk."""
        return np.random.default_rng([*self.seed, *seed_extension]).permutation(num_elements)
