"""Rows of training data, in memory or chunk by chunk, and their order in batches."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Int

from jeit.arguments import describe


class Rows(Protocol):
    """Rows of training data: `sizes`, how many each chunk has, `chunk`, those of one, and a `fingerprint`.

    The fingerprint changes with any of them. Sets larger than memory implement a class of their own.
    """

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of rows of each chunk."""
        ...

    @property
    def fingerprint(self) -> str:
        """Fingerprint of all that the rows hold, the same in another process."""
        ...

    def chunk(self, number: int) -> Any:
        """Arrays (rows, …), in tuples, dictionaries or modules, alike in all chunks but for their number of rows."""
        ...


class ArrayRows:
    """Rows in memory, one chunk: `arrays`, any tree of them, each (n, …)."""

    def __init__(self, arrays: Any, name: str = "training"):
        """Raises `ValueError`, about the argument `name`, for no arrays, and for numbers of rows that differ."""
        lengths = {len(leaf) if np.ndim(leaf) else -1 for leaf in jax.tree.leaves(arrays)}
        if len(lengths) != 1 or min(lengths) < 1:
            raise ValueError(
                f"{name} must be arrays of one and the same number of rows, 1 or more, such as (inputs, targets); it "
                f"is {describe(arrays)} of {sorted(lengths) or 'none'}."
            )
        self.arrays = arrays
        self.sizes = (lengths.pop(),)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the arrays."""
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(self.arrays):
            values = np.ascontiguousarray(leaf)
            digest.update(f"{values.dtype} {values.shape}".encode())
            digest.update(values.data)
        return digest.hexdigest()

    def chunk(self, number: int) -> Any:
        """All rows."""
        return self.arrays


class MappedRows:
    """Rows derived from others by a `function` of each chunk, which keeps their number.

    `name` describes the function, and all that it depends on except the rows.
    """

    def __init__(self, rows: Rows, function: Callable[[Any], Any], name: str):
        self.rows, self.function, self.name = rows, function, name

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of rows of each chunk."""
        return self.rows.sizes

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the rows, with the name."""
        return f"{self.rows.fingerprint}, {self.name}"

    def chunk(self, number: int) -> Any:
        """The function of a chunk of the rows."""
        return self.function(self.rows.chunk(number))


class Leg(NamedTuple):
    """Consecutive batches of one chunk: its number, which `rows` (b, batch) they take, and the number of the first of
    them in the whole training."""

    chunk: int
    rows: Int[np.ndarray, "b batch"]
    first: int


class Order:
    """The order of rows in batches.

    In every epoch all chunks are in another order, and the rows within each too; rows that fill no batch are left out,
    others each time. The order depends on `seed` only, so that a position in the data is one number, that of the batch.
    """

    def __init__(self, sizes: tuple[int, ...], batch: int, seed: list[int]):
        self.batch, self.seed = min(batch, *sizes), seed
        self.batches = [size // self.batch for size in sizes]
        self.sizes = sizes

    @property
    def an_epoch(self) -> int:
        """Number of batches of an epoch."""
        return sum(self.batches)

    def legs(self, first: int, last: int, most: int) -> Iterator[Leg]:
        """Batches from `first` to `last`, exclusive, in legs of `most` at most, each within one chunk."""
        while first < last:
            epoch, place = divmod(first, self.an_epoch)
            chunks = self._shuffled(len(self.sizes), epoch)
            ends = np.cumsum([self.batches[one] for one in chunks])
            which = int(np.searchsorted(ends, place, side="right"))
            chunk = int(chunks[which])
            within = place - (int(ends[which]) - self.batches[chunk])
            number = min(most, last - first, int(ends[which]) - place)
            rows = self._shuffled(self.sizes[chunk], epoch, 1 + chunk)[within * self.batch :][: number * self.batch]
            yield Leg(chunk, rows.reshape(number, self.batch), first)
            first += number

    def _shuffled(self, number: int, *place: int) -> np.ndarray:
        return np.random.default_rng([*self.seed, *place]).permutation(number)
