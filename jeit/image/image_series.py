"""Series of images of one body: the mean change of a region over time, and the functional image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Real
from numpy.typing import ArrayLike

from jeit.mesh import Mesh, measures


@dataclass(frozen=True)
class ImageSeries:
    """Changes of conductivity over time.

    **Fields**: `mesh`; `changes` (F, m) in S/m (2-D: S), a row of NaN for a frame without an image; `times` (F,)
    seconds, rising; `background`, the conductivity that they are changes of, S/m (2-D: S).

    Raises `ValueError` where shapes disagree, times do not rise, and where no frame has an image.
    """

    mesh: Mesh
    changes: Real[np.ndarray, "F m"]
    times: Float[np.ndarray, " F"]
    background: float = float("nan")

    def __post_init__(self):
        changes, times = np.asarray(self.changes), np.asarray(self.times, float)
        if changes.ndim != 2 or changes.shape[1] != self.mesh.num_cells or changes.dtype.kind != "f":
            raise ValueError(
                f"changes are {changes.dtype} of shape {changes.shape}; give (frames, {self.mesh.num_cells}), one "
                "number for each cell."
            )
        if times.shape != changes.shape[:1] or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise ValueError(f"times must be {len(changes)} seconds that rise, one for each frame.")
        object.__setattr__(self, "changes", changes)
        object.__setattr__(self, "times", times)
        if not self.imaged.any():
            raise ValueError("changes: no frame has an image.")

    @property
    def imaged(self) -> Bool[np.ndarray, " F"]:
        """(F,) True for frames that have an image."""
        return np.isfinite(self.changes[:, 0]) & np.isfinite(self.changes[:, -1])

    @property
    def frame_rate(self) -> float | None:
        """Frames in a second, over all; None for one frame."""
        return float((len(self.times) - 1) / (self.times[-1] - self.times[0])) if len(self.times) > 1 else None

    @property
    def unit(self) -> str:
        """Unit of the changes."""
        return "S" if self.mesh.dimension == 2 else "S/m"

    def functional(self) -> Float[np.ndarray, " m"]:
        """(m,) the standard deviation of every cell over time: the functional image, of what moves."""
        return self.changes[self.imaged].std(axis=0, dtype=float)

    def mean_change(self, region: ArrayLike) -> Float[np.ndarray, " F"]:
        """(F,) the mean change in a region, by the size of its cells; NaN for frames without an image.

        `region` (m,): True for its cells (`ball_region`, `box_region`, `half_region`). Raises `ValueError` for another
        shape, and an empty one.
        """
        chosen = np.asarray(region)
        if chosen.dtype != bool or chosen.shape != (self.mesh.num_cells,) or not chosen.any():
            raise ValueError(f"region must be {self.mesh.num_cells} booleans, one a cell, at least one of them True.")
        size = np.asarray(measures(self.mesh))[chosen]
        return self.changes[:, chosen].astype(float) @ (size / size.sum())
