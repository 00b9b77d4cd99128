"""`Locations`: position and status of each frame of a recording."""

from __future__ import annotations

import warnings
from enum import StrEnum

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from jeit_solvers.module import Module

# Number of frames up to which a computation with NumPy is faster than compiling it.
MAX_NUMPY_FRAMES = 1024


class LocationStatus(StrEnum):
    """Status of a frame; see `Locations` for the meaning of each."""

    TOUCH = "touch"
    NO_TOUCH = "no touch"
    OUTSIDE = "outside"
    TWO_TOUCHES = "two touches"
    AMBIGUOUS = "ambiguous"
    MISFIT = "misfit"
    UNUSABLE = "unusable"


class Locations(Module):
    """Positions and status of F frames, from M microphones.

    - `times`: (F,) middle of each frame in seconds.
    - `position`: (F, d) in metres; `covariance`: (F, d, d) in m²; `strength`: (F,) in the unit of intensity. NaN where
      no touch was located.
    - `status`: (F,) `LocationStatus` of each frame.
    - `misfit`: (F,) chi-square of the residuals; `freedom`: (F,) its degrees of freedom.
    - `used`: (F, M) mask of the microphones that were used.
    - `second`: (F, d) position in metres, and `second_strength`: (F,) strength, of the weaker of two touches; NaN for
      other frames.
    - `overlap`: length of a window divided by the hop between windows; the errors of overlapping windows are
      correlated.
    - `faults`: M descriptions of the fault of each microphone; "" for none.
    - `notes`: remarks on the whole recording.
    - `name`: name of the recording.

    Values of the status:

    - "touch": one source on the skin explains the intensities.
    - "no touch": no intensity exceeds the detection threshold.
    - "outside": the intensities indicate a position beyond the outline. `position` is the best position on the outline.
    - "two touches": one source does not explain the intensities, but two sources do.
    - "misfit": neither one nor two sources explain the intensities. `covariance` is enlarged accordingly.
    - "ambiguous": two positions explain the intensities about equally well, or the position is very uncertain.
    - "unusable": fewer than three microphones could be used.
    """

    times: Float[np.ndarray, " F"]
    position: Float[np.ndarray, "F d"]
    covariance: Float[np.ndarray, "F d d"]
    strength: Float[np.ndarray, " F"]
    status: np.ndarray
    misfit: Float[np.ndarray, " F"]
    freedom: Int[np.ndarray, " F"]
    used: Bool[np.ndarray, "F M"]
    second: Float[np.ndarray, "F d"]
    second_strength: Float[np.ndarray, " F"]
    overlap: float = eqx.field(static=True)
    faults: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @property
    def has_position(self) -> Bool[np.ndarray, " F"]:
        """Mask (F,) of the frames that have a position."""
        return np.asarray(np.isfinite(self.position).all(axis=1))

    @property
    def located(self) -> Bool[np.ndarray, " F"]:
        """Former name of `has_position`, which goes with the next version."""
        text = "Locations.located is now Locations.has_position; the old name goes with the next version."
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return self.has_position

    def counts(self) -> dict[str, int]:
        """Number of frames with each status that occurs."""
        return {str(status): int((self.status == status).sum()) for status in LocationStatus if status in self.status}
