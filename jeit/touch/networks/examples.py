"""Training touches of networks: in memory, or in the store of a set that may be larger."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from jeit.design.study.store import Store
from jeit.touch.simulate import IndentSet
from jeit.touch.training import ArrayRows, Rows

# The greatest number of touches that are in memory, and mixed, at once: 120 MB of 94 channels and 48 × 48 maps.
_AT_ONCE = 12_000


class Touches(Protocol):
    """Relative changes "change" (n, M) without noise, and maps "depth" (n, rows, columns) over the thickness."""

    def rows(self, *names: str) -> Rows:
        """The arrays of these names, float32, in this order; an array by itself where one is requested."""
        ...


class Examples(NamedTuple):
    """Touches in memory: relative changes (n, M) without noise, and depth maps (n, rows, columns) over the
    thickness."""

    change: Float[np.ndarray, "n M"]
    depth: Float[np.ndarray, "n r c"]

    def rows(self, *names: str) -> ArrayRows:
        """As of `Touches`."""
        arrays = tuple(np.asarray(getattr(self, name), np.float32) for name in names)
        return ArrayRows(arrays[0] if len(arrays) == 1 else arrays)


class StoredTouches:
    """The touches of a finished set of `simulate_presses`, read from its store on access.

    As many of its chunks are read at once as make `at_once` touches, or fewer.
    """

    def __init__(self, indents: IndentSet, path: str | Path, at_once: int = _AT_ONCE):
        """Raises `ValueError` for a store that is not finished, and as `Store` does."""
        store, chunks = Store(indents.contents(), path, create=False), indents.chunks
        checksums = store.finished()
        if len(checksums) < len(chunks):
            raise ValueError(
                f"path: {len(checksums)} of {len(chunks)} chunks of {path} are simulated; run simulate_presses again."
            )
        self.fingerprint = hashlib.sha256(repr(sorted(checksums.items())).encode()).hexdigest()
        self._arrays = store.open_dataset()
        # As evenly as possible: none is to be smaller than a batch.
        number = min(-(-indents.number // at_once), len(chunks))
        parts = np.array_split(np.arange(len(chunks)), number)
        self.spans = [range(chunks[part[0]].start, chunks[part[-1]].stop) for part in parts]

    def rows(self, *names: str) -> "StoredRows":
        """The arrays of `Touches`, chunk by chunk."""
        return StoredRows(self, names)

    def in_memory(self) -> Examples:
        """Read all touches into memory."""
        return Examples(self._arrays["change"].to_numpy(), self._arrays["depth"].to_numpy())

    def read(self, name: str, number: int) -> Float[np.ndarray, "n *shape"]:
        """Read an array of one chunk, float32."""
        span = self.spans[number]
        return self._arrays[name][span.start : span.stop].to_numpy().astype(np.float32, copy=False)


class StoredRows:
    """Arrays of `StoredTouches` by their names, as `Rows`."""

    def __init__(self, touches: StoredTouches, names: tuple[str, ...]):
        self._touches, self._names = touches, names

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of touches of each chunk."""
        return tuple(map(len, self._touches.spans))

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the touches, of their chunks, and of which arrays are read."""
        return f"{self._touches.fingerprint} {' '.join(self._names)} {self.sizes}"

    def chunk(self, number: int):
        """Read the arrays of one chunk; an array by itself where there is one name."""
        arrays = tuple(self._touches.read(name, number) for name in self._names)
        return arrays[0] if len(arrays) == 1 else arrays
