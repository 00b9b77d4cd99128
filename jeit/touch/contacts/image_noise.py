"""Noise of linear images of an untouched skin: the standard deviation of each cell, and their covariance."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy import sparse

from jeit.arguments import check_kind, counted, real_array
from jeit.inverse.linear.one_step import LinearReconstruction

# With fewer frames the deviation of the next one is not known.
_LEAST_FRAMES = 10
# Of normal noise: the standard deviation over the median of the absolute value; the number of deviations within which a
# cell is kept, and the standard deviation over that of the cells kept.
_NORMAL, _OFF, _WITHIN = 1.4826, 3.0, 1.0136
# The greatest number of rounds of clipping.
_ROUNDS = 20


class ImageNoise(eqx.Module):
    """Standard deviation of every cell, `deviation` (m,), in the unit of the image, and their covariance, if known.

    `factor` (r, m), whose product factorᵀ factor is the covariance; None where it is not known.
    """

    deviation: Float[np.ndarray, " m"]
    factor: Float[np.ndarray, "r m"] | None = None

    def __check_init__(self):
        """Check the fields. Raises `ValueError` for deviations that are negative or not finite, and factors of other
        cells."""
        wanted = "an array (m,), one number a cell, zero or more and finite, in the unit of the image"
        check_kind("deviation", self.deviation, (np.ndarray, jax.Array), wanted)
        deviation = real_array("deviation", self.deviation, wanted)
        if deviation.ndim != 1:
            raise ValueError(f"deviation must be {wanted}; it has shape {deviation.shape}.")
        if not (np.isfinite(deviation).all() and (deviation >= 0).all()):
            raise ValueError(f"deviation must be {wanted}; some of it is negative or not finite.")
        if self.factor is not None and np.shape(self.factor)[1:] != deviation.shape:
            shape = np.shape(self.factor)
            raise ValueError(f"factor has shape {shape}; give (r, {deviation.size}), a column for each cell.")

    @classmethod
    def of_frames(cls, reconstruction: LinearReconstruction, frames: Float[np.ndarray, "n M"]) -> "ImageNoise":
        """Estimate the noise from repeated frames (n, M) volts of the untouched skin, ten at least.

        Their deviations from the mean are imaged. Frames that span as long as readings will last include drift, which
        frames of one moment do not. Raises `ValueError` for fewer frames, other channels, NaN, and frames that are all
        the same.
        """
        check_kind("reconstruction", reconstruction, LinearReconstruction, "a linear one, such as of one_step(...)")
        frames = real_array("frames", frames, "voltages (n, M)")
        if frames.ndim != 2 or len(frames) < _LEAST_FRAMES:
            raise ValueError(
                f"frames has shape {frames.shape}; give (n, {reconstruction.num_measurements}) volts of an untouched "
                f"skin, {counted(_LEAST_FRAMES, 'frame')} or more."
            )
        if (frames == frames[0]).all():
            raise ValueError("frames are all the same and show no noise. Give what was read, not copies of a frame.")
        strayed = np.asarray(reconstruction.image(frames - frames.mean(axis=0)))
        return cls._of_factor(strayed / np.sqrt(len(frames) - 1))

    @classmethod
    def of_channels(cls, reconstruction: LinearReconstruction, deviation: ArrayLike) -> "ImageNoise":
        """Compute the noise from the standard deviation of each channel, (M,) or one number, volts; channels
        independent.

        The difference of two such frames deviates by √2 times as much. Raises `ValueError` for those that are negative,
        not finite, all zero, or of another number of channels.
        """
        check_kind("reconstruction", reconstruction, LinearReconstruction, "a linear one, such as of one_step(...)")
        number = reconstruction.num_measurements
        deviation = real_array("deviation", deviation, f"one number, or ({number},), volts")
        if deviation.shape not in ((), (number,)):
            raise ValueError(f"deviation has shape {deviation.shape}; give one number, or ({number},), volts.")
        if not (np.isfinite(deviation).all() and (deviation >= 0).all() and deviation.any()):
            raise ValueError("deviation must be finite, zero or more, and not zero for all channels, in volts.")
        return cls._of_factor(np.broadcast_to(deviation, number)[:, None] * np.asarray(reconstruction.matrix).T)

    @classmethod
    def of_image(cls, image: Float[np.ndarray, " m"]) -> "ImageNoise":
        """Estimate the noise from an image (m,) alone, with or without contacts, by sigma clipping.

        It is the standard deviation, the same for all cells, after cells more than three deviations from the median are
        removed repeatedly. Artefacts of a contact all over an image, and ringing, count as noise, so that weak contacts
        beside strong ones are not found; and cells that are noisier than most are taken for contacts. Raises
        `ValueError` for an image that is not (m,), finite and real.
        """
        values = np.asarray(image)
        if values.ndim != 1 or not values.size or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
            raise ValueError("image must be real and finite, one value a cell (m,).")
        return cls(np.full(values.shape, _clipped_deviation(values)))

    @classmethod
    def _of_factor(cls, factor: np.ndarray) -> "ImageNoise":
        return cls(np.sqrt((factor**2).sum(axis=0)), factor)

    def distance(self, slope: Float[np.ndarray, "m 2"]) -> float:
        """Root mean square displacement, metres, of a place whose derivative by the image is `slope` (m, 2).

        The slope is in metres over the image's unit. Where the covariance of cells is not known, it is the upper bound.
        """
        if self.factor is None:
            return float(np.linalg.norm(self.deviation @ np.abs(slope)))
        return float(np.linalg.norm(self.factor @ slope))

    def smoothed(self, smoothing: sparse.csr_array) -> Float[np.ndarray, " m"]:
        """Standard deviation (m,) of the image after smoothing by a matrix (m, m).

        Where the covariance of cells is not known, it is the upper bound.
        """
        if self.factor is None:
            return smoothing @ self.deviation
        return np.sqrt(((smoothing @ self.factor.T) ** 2).sum(axis=1))


def _clipped_deviation(values: Float[np.ndarray, " m"]) -> float:
    """Standard deviation of the values within three deviations of the median, initially from the median distance."""
    kept = values
    for _ in range(_ROUNDS):
        middle = np.median(kept)
        spread = _NORMAL * np.median(np.abs(kept - middle))
        within = values[np.abs(values - middle) <= _OFF * spread]
        if len(within) == len(kept):
            break
        kept = within
    return float(_WITHIN * kept.std())
