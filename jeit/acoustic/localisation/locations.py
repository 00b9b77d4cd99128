"""`Locations`: position and status of every frame of a recording."""

from __future__ import annotations

from enum import StrEnum

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

# Number of frames up to which NumPy is faster than compiling a program.
FEW_FRAMES = 1024


class LocationStatus(StrEnum):
    """Status of a frame; see `Locations`."""

    TOUCH = "touch"
    NO_TOUCH = "no touch"
    OUTSIDE = "outside"
    TWO_TOUCHES = "two touches"
    AMBIGUOUS = "ambiguous"
    MISFIT = "misfit"
    UNUSABLE = "unusable"


class Locations(eqx.Module):
    """Positions and status of F frames of M microphones.

    - `times`: (F,) seconds; `status`: (F,) a `LocationStatus` each.
    - `position`: (F, d) metres; `covariance`: (F, d, d) m²; `strength`: (F,). NaN where there is no touch.
    - `misfit`: (F,) chi-square of the residuals of one source, with `freedom`: (F,) degrees.
    - `used`: (F, M) which microphones were used. `faults`: M strings, the fault of each microphone ("" if none).
    - `second`: (F, d) and `second_strength`: (F,), of the weaker of two touches, NaN elsewhere.
    - `overlap`: number of windows that share a sample, whose errors are correlated.
    - `notes`: remarks on the whole recording.

    Status: "touch"; "no touch", nothing is above the floor; "outside", the intensities indicate a position beyond the
    outline, and the position given is the best on it; "two touches", one source does not explain the frame but two do;
    "misfit", neither does, and the covariance is widened accordingly; "ambiguous", two positions explain the frame
    about as well; "unusable", fewer than three microphones could be used.
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
    def located(self) -> Bool[np.ndarray, " F"]:
        """Frames that have a position."""
        return np.asarray(np.isfinite(self.position).all(axis=1))

    def counts(self) -> dict[str, int]:
        """Number of frames of each status."""
        return {str(status): int((self.status == status).sum()) for status in LocationStatus if status in self.status}
