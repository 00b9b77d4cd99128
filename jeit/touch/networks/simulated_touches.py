"""Simulated touches that train and test a network, in memory or in the store of a finished set."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from jeit.design.study.store import Store
from jeit.touch.simulate import IndentSet
from jeit.touch.training import ArrayRows, Rows

# Maximum number of simulated touches that are in memory, and shuffled, together: 120 MB for 94 channels and 48 × 48
# maps.
_MAX_TOUCHES_IN_MEMORY = 12_000


class SimulatedTouches(Protocol):
    """Simulated touches: voltage changes "change" (touches, channels), depth maps "depth" (touches, rows, columns).

    Changes are relative, without noise. Depths are divided by the skin's thickness.
    """

    def rows(self, *names: str) -> Rows:
        """Return the float32 arrays "change" or "depth" in the order of `names`; for a single name, the array
        itself."""
        ...


class TouchExamples(NamedTuple):
    """Simulated touches in memory.

    **Fields**: `change` (touches, channels): relative voltage changes without noise; `depth` (touches, rows, columns):
    depth maps, divided by the thickness of the skin.
    """

    change: Float[np.ndarray, "n M"]
    depth: Float[np.ndarray, "n r c"]

    def rows(self, *names: str) -> ArrayRows:
        """Return the arrays of these names, as `SimulatedTouches.rows` does."""
        touch_arrays = tuple(np.asarray(getattr(self, array_name), np.float32) for array_name in names)
        return ArrayRows(touch_arrays[0] if len(touch_arrays) == 1 else touch_arrays)


class StoredTouches:
    """Simulated touches of a finished set of `simulate_presses`, read from the set's store on access.

    Several chunks of the store are read together as one larger chunk of about `max_chunk_size` touches or fewer.
    """

    def __init__(self, indents: IndentSet, path: str | Path, max_chunk_size: int = _MAX_TOUCHES_IN_MEMORY):
        """Open the store of touches. Raises `ValueError` if the set is not finished, and as `Store` does."""
        store, chunks = Store(indents.contents(), path, create=False), indents.chunks
        chunk_checksums = store.finished_checksums()
        if len(chunk_checksums) < len(chunks):
            raise ValueError(
                f"path: {len(chunk_checksums)} of {len(chunks)} chunks of {path} are simulated; run "
                "simulate_presses again."
            )
        self.fingerprint = hashlib.sha256(repr(sorted(chunk_checksums.items())).encode()).hexdigest()
        self._dataset = store.open_dataset()
        # The chunks are of similar size, so that no chunk is smaller than a batch.
        num_chunks = min(-(-indents.number // max_chunk_size), len(chunks))
        grouped_chunks = np.array_split(np.arange(len(chunks)), num_chunks)
        self.row_ranges = [
            range(chunks[chunk_group[0]].start, chunks[chunk_group[-1]].stop) for chunk_group in grouped_chunks
        ]

    def rows(self, *names: str) -> "StoredRows":
        """Return the arrays of these names, to be read chunk by chunk; see `SimulatedTouches`."""
        return StoredRows(self, names)

    def in_memory(self) -> TouchExamples:
        """Read all touches of the set into memory."""
        return TouchExamples(self._dataset["change"].to_numpy(), self._dataset["depth"].to_numpy())

    def read(self, name: str, chunk: int) -> Float[np.ndarray, "n *shape"]:
        """Read the array `name` of one chunk of touches, float32."""
        row_range = self.row_ranges[chunk]
        return self._dataset[name][row_range.start : row_range.stop].to_numpy().astype(np.float32, copy=False)


class StoredRows:
    """The named arrays of `StoredTouches`, with the interface of `Rows`."""

    def __init__(self, touches: StoredTouches, names: tuple[str, ...]):
        self._touches, self._array_names = touches, names

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of simulated touches of each chunk."""
        return tuple(map(len, self._touches.row_ranges))

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the touches, the names of the arrays, and the sizes of the chunks."""
        return f"{self._touches.fingerprint} {' '.join(self._array_names)} {self.sizes}"

    def chunk(self, index: int):
        """Read the arrays of one chunk of touches; for a single name, returns the array itself."""
        touch_arrays = tuple(self._touches.read(array_name, index) for array_name in self._array_names)
        return touch_arrays[0] if len(touch_arrays) == 1 else touch_arrays
