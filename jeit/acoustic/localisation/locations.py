"""`Locations`: position and status of each frame of a recording."""

from __future__ import annotations

import warnings
from enum import StrEnum

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from jeit_solvers.module import Module

# Number of frames up to which a computation with NumPy is faster than compilation by JAX.
MAX_NUMPY_FRAMES = 1024


class LocationStatus(StrEnum):
    """Status of the location of a frame; see `Locations` for the meaning of each status."""

    TOUCH = "touch"
    NO_TOUCH = "no touch"
    OUTSIDE = "outside"
    TWO_TOUCHES = "two touches"
    AMBIGUOUS = "ambiguous"
    MISFIT = "misfit"
    UNUSABLE = "unusable"


class Locations(Module):
    """Positions of touches and status of F frames, from M microphones.

    - `times`: (F,) time of the middle of each frame in seconds.
    - `position`: (F, d) position of the touch in metres; `covariance`: (F, d, d) covariance of the position in m²;
      `strength`: (F,) strength in the unit of intensity. NaN where no touch was located.
    - `status`: (F,) `LocationStatus` of each frame.
    - `misfit`: (F,) chi-square of the residuals of the levels; `freedom`: (F,) degrees of freedom of the misfit.
    - `used`: (F, M) mask of the microphones used in each frame.
    - `second`: (F, d) position in metres, and `second_strength`: (F,) strength, of the weaker of two touches; NaN for
      frames without a second touch.
    - `overlap`: length of a window divided by the hop between windows; the errors of positions from overlapping windows
      are correlated.
    - `faults`: description of the fault of each of the M microphones; "" for no fault.
    - `notes`: remarks on the recording as a whole.
    - `name`: name of the recording.

    Status of a frame:

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
        """Mask (F,) of the frames for which a position was estimated."""
        return np.asarray(np.isfinite(self.position).all(axis=1))

    @property
    def located(self) -> Bool[np.ndarray, " F"]:
        """Former name of `has_position`, which will be removed in the next version."""
        deprecation_message = (
            "Locations.located is now Locations.has_position; the old name goes with the next version."
        )
        warnings.warn(deprecation_message, DeprecationWarning, stacklevel=2)
        return self.has_position

    def counts(self) -> dict[str, int]:
        """Number of frames with each status that occurs in the recording."""
        return {str(status): int((self.status == status).sum()) for status in LocationStatus if status in self.status}
